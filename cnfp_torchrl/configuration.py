"""Where the Hydra configuration files are."""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent


def config_directory() -> Path:
    """Return the folder of the Hydra configs: the wheel's own copy, else the checkout's `conf/`."""
    candidates = (_PACKAGE / "conf", _PACKAGE.parent / "conf")
    for candidate in candidates:
        if candidate.is_dir():
            return candidate
    raise FileNotFoundError(
        "the configuration files of cnfp_torchrl are missing, looked in: "
        + ", ".join(str(candidate) for candidate in candidates)
    )
