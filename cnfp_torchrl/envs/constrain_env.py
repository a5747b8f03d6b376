"""Environments that publish their constraints, made in one call."""

from __future__ import annotations

from collections.abc import Sequence

from torchrl.envs import Compose, EnvBase, TransformedEnv

from cnfp_torchrl.envs.anchor_transform import ConstraintAnchor
from cnfp_torchrl.envs.geometry_transform import GeometryTransform
from cnfp_torchrl.keys import refuse_string
from cnfp_torchrl.modules import (
    action_bounds,
    constraint_bijectors,
    in_order,
    publishes_constraints,
)

_EXAMPLE = "write constrain_env(env, SpeedLimit(), KeepDistance())"


def constrain_env(
    env: EnvBase,
    *geometries: GeometryTransform,
    order: Sequence[str] | None = None,
    with_anchor: bool = True,
    validate: bool | None = None,
    compile: bool = False,
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
        with_anchor: Whether to publish anchor, active flags and relaxations. Flows that guarantee
            nothing (``squash``, ``unconstrained``) act without them, and steps take less time.
        validate: Whether the values that the geometries read and return are checked at each step,
            see `GeometryTransform`; None leaves that to each of them.
        compile: Whether steps compute geometry and anchors by a compiled function, see
            `ConstraintAnchor`. It takes some ten seconds to compile at the first step.

    Raises:
        TypeError: when the environment is no `EnvBase`, a geometry is no `GeometryTransform` (but
            a class or a list, for example), or the order is a string.
        ValueError: without geometries, for an action spec that is not one of vectors with bounds,
            or when an order does not name each constraint once.
    """
    if compile and not with_anchor:
        raise ValueError(
            "compile: expected False with with_anchor=False, given True; the compiled function is "
            "called by the transform that computes the anchor"
        )
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
        if validate is not None:
            geometry.validate = validate
    action_bounds(env.full_action_spec, env.action_key)
    before = constraint_bijectors(env) if publishes_constraints(env) else []
    refuse_string("order", order)
    if not with_anchor and order is not None:
        # There is no anchor to state the priority, which is then that of the transforms.
        wanted = {name: position for position, name in enumerate(order)}
        geometries = tuple(sorted(geometries, key=lambda geometry: wanted.get(geometry.name, 0)))
    published = TransformedEnv(env, Compose(*geometries), auto_unwrap=True)
    _ = published.observation_spec  # calls each geometry for its first set
    bijectors = [*before, *(own for geometry in geometries for own in geometry.bijectors)]
    ordered = in_order(bijectors, order)
    if with_anchor:
        return published.append_transform(ConstraintAnchor(ordered, compile=compile))
    if ordered != bijectors:
        raise ValueError(
            f"order: expected the constraints published before, {[g.name for g in before]}, "
            f"to come first where there is no anchor, given {list(order or ())}; pass all "
            "geometries to one constrain_env, or leave with_anchor as it is"
        )
    return published


def _kind(given: object) -> str:
    return f"the class {given.__name__}" if isinstance(given, type) else type(given).__name__
