"""Assembly of an environment from its base, its geometry transforms and the anchor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torchrl.envs import Compose, EnvBase, RewardSum, TransformedEnv

from cnfp_torchrl.envs import (
    ConstraintAnchor,
    GeometryTransform,
    RewardPenalty,
    constraint_bijectors,
    constraint_names,
)
from cnfp_torchrl.keys import COST_KEY


def make_environment(
    base: EnvBase,
    geometries: Mapping[str, GeometryTransform],
    *,
    order: Sequence[str],
    with_anchor: bool,
    penalty: RewardPenalty | None = None,
) -> TransformedEnv:
    """Return the environment whose states carry the constraints' geometry.

    Args:
        base: the environment; if it counts violations, ``constraint_names`` names its costs.
        geometries: transforms, one for each constraint, by its name.
        order: the constraints' names in order of application.
        with_anchor: also publish anchor and active flags, which exact flows need.
        penalty: the price of violations; ``episode_reward`` sums the reward without it.

    Raises:
        ValueError: when a geometry publishes under another name than its own, or the order does not
            name each constraint once.
    """
    for name, geometry in geometries.items():
        if geometry.name != name:
            raise ValueError(
                f"env.geometry.{name}.name: expected '{name}', given '{geometry.name}'"
            )
    env = TransformedEnv(base, Compose(*geometries.values(), RewardSum()), auto_unwrap=True)
    if penalty is not None:
        env.append_transform(penalty)
    if with_anchor:
        bijectors = constraint_bijectors(env) if geometries else []
        env.append_transform(ConstraintAnchor(bijectors, order))
    return env


def counted_constraints(env: EnvBase) -> tuple[str, ...]:
    """Return the names of the columns of ``cost``; none if the environment counts nothing."""
    return constraint_names(env) if COST_KEY in env.observation_spec.keys() else ()  # noqa: SIM118
