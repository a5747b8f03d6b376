"""Hard, state-dependent action constraints for any TorchRL actor, with exact log-densities."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
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

_ROOMS = ("keys", "geometry", "bijectors", "distributions", "modules", "envs")

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


def __getattr__(name: str) -> Any:
    """Return what the face has, or a room, which are imported when they are first asked for.

    Not with the face: torch takes seconds, in which no command could answer Ctrl-C.
    """
    if name == "__version__":
        return _version()
    if name in _ROOMS:
        return import_module(f"{__name__}.{name}")
    if name in __all__:
        rooms = (import_module(f"{__name__}.{room}") for room in _ROOMS)
        globals()[name] = found = next(getattr(room, name) for room in rooms if hasattr(room, name))
        return found
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(__name__)
    except PackageNotFoundError:  # a source tree on the path, never installed
        return "0+unknown"


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_ROOMS})
