"""Hard, state-dependent action constraints for any TorchRL actor, with exact log-densities."""

from importlib.metadata import PackageNotFoundError, version

from cnfp_torchrl.distributions import ConstrainedFlow
from cnfp_torchrl.envs import ActionGuard, GeometryTransform, constrain_env
from cnfp_torchrl.geometry import (
    Ball,
    Box,
    ConstraintSet,
    Ellipsoid,
    HalfSpaces,
    PositivePart,
    Region,
    TaskSpaceBall,
    VisibleRegion,
    WeightedL1Ball,
)
from cnfp_torchrl.modules import (
    ExecutedActionGuard,
    SafeRandomPolicy,
    constrain,
    make_constrained_actor,
)

try:
    __version__ = version("cnfp_torchrl")
except PackageNotFoundError:  # a source tree on the path, never installed
    __version__ = "0+unknown"

__all__ = [
    "ActionGuard",
    "Ball",
    "Box",
    "ConstrainedFlow",
    "ConstraintSet",
    "Ellipsoid",
    "ExecutedActionGuard",
    "GeometryTransform",
    "HalfSpaces",
    "PositivePart",
    "Region",
    "SafeRandomPolicy",
    "TaskSpaceBall",
    "VisibleRegion",
    "WeightedL1Ball",
    "__version__",
    "constrain",
    "constrain_env",
    "make_constrained_actor",
]
