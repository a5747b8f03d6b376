"""Where the Hydra configuration files are."""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]


def config_directory(package: Path = _PACKAGE) -> Path:
    """Return the folder of the Hydra configs: the wheel's own copy, else the checkout's ``conf/``.

    Args:
        package: The folder of the installed package.

    Raises:
        FileNotFoundError: when there is neither.
    """
    candidates = (package / "conf", package.parent / "conf")
    for candidate in candidates:
        if candidate.is_dir():
            return candidate
    raise FileNotFoundError(
        "the configuration files of cnfp_torchrl are missing, looked in: "
        + ", ".join(str(candidate) for candidate in candidates)
    )
