"""The constraints that an environment publishes, read off its transforms."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

from torchrl.envs import Compose, DTypeCastTransform, EnvBase, Transform, TransformedEnv

from cnfp_torchrl.modules.constraint_bijector import ConstraintBijector


class ConstraintPublisher(ABC):
    """The interface of environment transforms that publish constraints.

    Implemented by the transforms of `cnfp_torchrl.envs`.
    """

    states_order: ClassVar[bool] = False
    """Whether `bijectors` are those of all constraints, in order of application."""

    @property
    @abstractmethod
    def bijectors(self) -> list[ConstraintBijector]:
        """The modules of the constraints that the transform publishes, one for each."""

    def publishes_for(self, other: ConstraintPublisher) -> bool:
        """Tell whether another transform can leave it to this one to publish its constraint."""
        return False


def constraint_bijectors(env: EnvBase) -> list[ConstraintBijector]:
    """Return a bijector for each constraint that an environment publishes.

    They come in order of application, that of the environment's `ConstraintAnchor`, or without one
    that of its geometry transforms.

    Args:
        env: An environment such as `constrain_env` returns; not a batch of them in workers.

    Raises:
        ValueError: when it publishes no constraint, or one that its `ConstraintAnchor` leaves out,
            and when a transform behind that changes actions: the sets are not of those.
    """
    publishers = [t for t in appended_transforms(env) if isinstance(t, ConstraintPublisher)]
    if publishers:
        _ = env.observation_spec  # made at the first use, by a set of each constraint
    ordered = [p for p in publishers if p.states_order]
    published = [b for p in publishers if not p.states_order for b in p.bijectors]
    bijectors = ordered[-1].bijectors if ordered else published
    if not bijectors:
        raise ValueError(
            f"env: expected one that publishes at least one constraint, given "
            f"{type(env).__name__} without a GeometryTransform of its own; make it with "
            "constrain_env, and before batching: the transforms in the workers of a SerialEnv or "
            "ParallelEnv are out of reach, so call this on one of the environments it is made of"
        )
    known = {bijector.name for bijector in bijectors}
    if left_out := [b.name for b in published if b.name not in known]:
        raise ValueError(
            f"env: expected its ConstraintAnchor to know all constraints, given one with "
            f"{sorted(known)} that leaves out {left_out}; pass all geometries to one constrain_env"
        )
    if (changing := changed_actions(env)) is not None:
        raise ValueError(
            f"env: expected constraints of the actions that it takes, given {changing} behind "
            "them, which maps these to others; with ConstrainedActions any actor is safe as it "
            "is, and other transforms of actions belong into the environment that is constrained"
        )
    return bijectors


def publishes_constraints(env: EnvBase) -> bool:
    """Tell whether an environment's own transforms publish any constraint."""
    publishers = (t for t in appended_transforms(env) if isinstance(t, ConstraintPublisher))
    # An anchor alone publishes none.
    return any(not p.states_order or p.bijectors for p in publishers)


def changed_actions(env: EnvBase) -> str | None:
    """Return the name of a transform that changes actions behind a `ConstraintAnchor`, or None."""
    transforms = iter(appended_transforms(env))
    if not any(isinstance(t, ConstraintPublisher) and t.states_order for t in transforms):
        return None
    for transform in transforms:
        casts = isinstance(transform, DTypeCastTransform)
        if env.action_key in transform.in_keys_inv and not casts:
            return type(transform).__name__
    return None


def appended_transforms(env: EnvBase) -> list[Transform]:
    """Return the transforms of an environment in order, none if it has none.

    Those in the workers of a batched environment are not among them.
    """
    if not isinstance(env, TransformedEnv):
        return []
    return [*appended_transforms(env.base_env), *_flat(env.transform)]


def _flat(transform: Transform) -> list[Transform]:
    if not isinstance(transform, Compose):
        return [transform]
    return [part for child in transform for part in _flat(child)]
