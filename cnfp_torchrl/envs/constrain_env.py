"""Environments that publish their constraints, made in one call."""

from __future__ import annotations

from collections.abc import Sequence

from torchrl.envs import Compose, EnvBase, TransformedEnv

from cnfp_torchrl.envs.anchor_transform import ConstraintAnchor
from cnfp_torchrl.envs.geometry_transform import GeometryTransform
from cnfp_torchrl.modules import ConstraintPublisher, appended_transforms, constraint_bijectors

_EXAMPLE = "write constrain_env(env, SpeedLimit(), KeepDistance())"


def constrain_env(
    env: EnvBase, *geometries: GeometryTransform, order: Sequence[str] | None = None
) -> TransformedEnv:
    """Return an environment that publishes the geometry of its constraints in every state.

    Beside the sets it publishes anchor, active flags and relaxations. `cnfp_torchrl.constrain`, the
    counterpart, takes constraints, their order and the action bounds from the returned environment.

    Constraints that the environment publishes already come first, with lower priority.

    Args:
        env: An environment with a bounded action spec; not changed.
        geometries: One transform for each constraint.
        order: The constraints' names in order of application, the last with the highest priority
            (lexicographic priority); None takes the order of the geometries.

    Raises:
        TypeError: when the environment is no `EnvBase`, a geometry is no `GeometryTransform` (but
            a class or a list, for example), or the order is a string.
        ValueError: without geometries, or when an order does not name each constraint once.
    """
    if not isinstance(env, EnvBase):
        raise TypeError(
            f"env: expected a TorchRL environment, given {_kind(env)}; wrap one of Gymnasium's in "
            "torchrl.envs.GymWrapper"
        )
    if not geometries:
        raise ValueError(f"geometries: expected at least one, given none; {_EXAMPLE}")
    for geometry in geometries:
        if not isinstance(geometry, GeometryTransform):
            raise TypeError(
                f"geometries: expected each to be a GeometryTransform, given {_kind(geometry)}; "
                f"{_EXAMPLE}"
            )
    publishes = any(isinstance(t, ConstraintPublisher) for t in appended_transforms(env))
    before = constraint_bijectors(env) if publishes else []
    published = TransformedEnv(env, Compose(*geometries), auto_unwrap=True)
    _ = published.observation_spec  # calls each geometry for its first set
    bijectors = [*before, *(own for geometry in geometries for own in geometry.bijectors)]
    return published.append_transform(ConstraintAnchor(bijectors, order))


def _kind(given: object) -> str:
    return f"the class {given.__name__}" if isinstance(given, type) else type(given).__name__
