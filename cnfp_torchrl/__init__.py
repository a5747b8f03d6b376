"""Hard, state-dependent action constraints for any TorchRL actor, with exact log-densities."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("cnfp_torchrl")
except PackageNotFoundError:  # a source tree on the path, never installed
    __version__ = "0+unknown"

__all__ = ["__version__"]
