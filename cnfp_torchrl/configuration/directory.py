"""Where the Hydra configuration files are, and what they compose to."""

from pathlib import Path

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

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


def compose_config(*overrides: str, name: str = "train") -> DictConfig:
    """Return a shipped configuration as the command line composes it, for scripts and notebooks.

    Args:
        overrides: The overrides, such as ``flow=radial``, in Hydra's grammar.
        name: The name of the main file in ``conf/``.
    """
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        return compose(name, overrides=list(overrides))
