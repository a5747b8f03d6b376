"""The transform that finds, once per state, the anchor of the allowed region."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv

from cnfp_torchrl.envs.geometry_transform import (
    SAFE_ACTION_KEY,
    GeometryTransform,
    appended_transforms,
)
from cnfp_torchrl.geometry import Box, GeometryError
from cnfp_torchrl.geometry.anchors import lexicographic_anchor
from cnfp_torchrl.modules.constraint_bijector import ANCHOR_KEY, ConstraintBijector, in_order
from cnfp_torchrl.modules.flow_module import action_bounds

_EXAMPLE = "write constrain_env(env, BatteryGeometry(), ObstacleGeometry())"


def constraint_bijectors(env: EnvBase) -> list[ConstraintBijector]:
    """Return a bijector for each constraint that the environment publishes.

    They come in order of application: that of the environment's `ConstraintAnchor`, or without one
    that of its geometry transforms.

    Args:
        env: such as `constrain_env` returns; one environment, no batch of environments in workers.

    Raises:
        ValueError: when it publishes no constraint, or one that its `ConstraintAnchor` leaves out.
    """
    anchors = [each for each in appended_transforms(env) if isinstance(each, ConstraintAnchor)]
    bijectors = anchors[-1].bijectors if anchors else _published(env)
    if not bijectors:
        raise ValueError(
            f"env: expected one that publishes at least one constraint, given "
            f"{type(env).__name__} without a GeometryTransform of its own; make it with "
            "constrain_env, and before batching: the transforms in the workers of a SerialEnv or "
            "ParallelEnv are out of reach, so call this on one of the environments it is made of"
        )
    known = {bijector.name for bijector in bijectors}
    if left_out := [each.name for each in _geometries(env) if each.name not in known]:
        raise ValueError(
            f"env: expected its ConstraintAnchor to know all constraints, given one with "
            f"{sorted(known)} that leaves out {left_out}; pass all geometries to one constrain_env"
        )
    return bijectors


def constrain_env(
    env: EnvBase, *geometries: GeometryTransform, order: Sequence[str] | None = None
) -> TransformedEnv:
    """Let an environment publish what each state allows: geometries, anchor and active flags.

    The counterpart of `cnfp_torchrl.modules.constrain`, which makes an actor heed them; its
    bijectors are ``constraint_bijectors(env)``.

    Args:
        env: with a bounded action spec; not changed.
        geometries: one transform for each constraint.
        order: the constraints' names in order of application, the last with the highest priority;
            None takes the order of the geometries. ``constraint_bijectors(env)`` keeps it.

    Raises:
        TypeError: when the environment or a geometry is none, such as a class or a list, or when
            the order is a string.
        ValueError: without geometries, or when an order does not name each constraint once.
    """
    if not isinstance(env, EnvBase):
        raise TypeError(
            f"env: expected a TorchRL environment, given {_kind(env)}; wrap one of Gymnasium's in "
            "torchrl.envs.GymWrapper"
        )
    if not geometries:
        raise ValueError(f"geometries: expected at least one, given none; {_EXAMPLE}")
    for each in geometries:
        if not isinstance(each, GeometryTransform):
            raise TypeError(
                f"geometries: expected each to be a GeometryTransform, given {_kind(each)}; "
                f"{_EXAMPLE}"
            )
    published = TransformedEnv(env, Compose(*geometries), auto_unwrap=True)
    return published.append_transform(ConstraintAnchor(_published(published), order))


def _kind(given: object) -> str:
    return f"the class {given.__name__}" if isinstance(given, type) else type(given).__name__


def _published(env: EnvBase) -> list[ConstraintBijector]:
    geometries = _geometries(env)
    state = env.observation_spec.zero() if geometries else None
    return [ConstraintBijector(each.name, type(each.checked_set(state))) for each in geometries]


def _geometries(env: EnvBase) -> list[GeometryTransform]:
    return [each for each in appended_transforms(env) if isinstance(each, GeometryTransform)]


class ConstraintAnchor(Transform):
    """Publish the anchor of the allowed region and which constraints hold, for exact flows.

    Reads the sets that the geometry transforms before it publish, and a candidate at
    ``("constraints", "safe_action")`` if there is one: a known safe action makes the anchor cheap.
    It is checked; where it fails, the general method decides
    (`cnfp_torchrl.geometry.anchors.lexicographic_anchor`).

    Writes ``("constraints", "anchor")``, ``(*batch, d)``, and ``("constraints", NAME, "active")``,
    boolean ``(*batch,)``, False where the constraint cannot hold together with those of higher
    priority.

    Args:
        bijectors: one for each constraint; they know where the geometry lies.
        order: the constraints' names in order of application, the last with the highest priority;
            None takes the bijectors' own order. The same as the flow's.

    Raises:
        TypeError: when a bijector is none, or the order is a string.
        ValueError: when an order does not name each constraint exactly once.
    """

    _low: Tensor | None
    _high: Tensor | None

    def __init__(
        self, bijectors: Sequence[ConstraintBijector], order: Sequence[str] | None = None
    ) -> None:
        super().__init__()
        self._bijectors = in_order(bijectors, order)
        # Of the action bounds, read from the parent once; buffers, to move with the environment.
        self.register_buffer("_low", None, persistent=False)
        self.register_buffer("_high", None, persistent=False)

    @property
    def bijectors(self) -> list[ConstraintBijector]:
        """One for each constraint, in order of application."""
        return list(self._bijectors)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        bounds = self._action_bounds()
        # In the dtype of the actions, as the flow will see them.
        sets = [bijector.get_set(next_tensordict).to(bounds.dtype) for bijector in self._bijectors]
        for bijector, each in zip(self._bijectors, sets, strict=True):
            if each.dim != bounds.dim:
                raise GeometryError(
                    f"constraint '{bijector.name}': expected a set of actions with {bounds.dim} "
                    f"components, as the action spec has, given one with {each.dim}"
                )
        candidate = next_tensordict.get(SAFE_ACTION_KEY, None)
        if candidate is not None:
            candidate = candidate.to(bounds.dtype)
        anchor, active = lexicographic_anchor([bounds, *sets], candidate)
        batch = next_tensordict.batch_size
        next_tensordict.set(ANCHOR_KEY, anchor.expand(*batch, anchor.shape[-1]))
        for stage, bijector in enumerate(self._bijectors, start=1):
            next_tensordict.set(bijector.active_key, active[..., stage].expand(batch))
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Fill in anchor and flags of stored transitions, at root and under next."""
        self._call(tensordict)
        if "next" in tensordict.keys():  # noqa: SIM118 - a tensordict iterates over its batch
            self._call(tensordict.get("next"))
        return tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the anchor and the flags."""
        assert isinstance(observation_spec, Composite)
        bounds, batch = self._action_bounds(), observation_spec.shape
        observation_spec[ANCHOR_KEY] = Unbounded(
            (*batch, bounds.dim), dtype=bounds.dtype, device=observation_spec.device
        )
        for bijector in self._bijectors:
            observation_spec[bijector.active_key] = Binary(
                shape=batch, dtype=torch.bool, device=observation_spec.device
            )
        return observation_spec

    def _action_bounds(self) -> Box:
        if self._low is None or self._high is None:
            if self.parent is None:
                raise RuntimeError(
                    "ConstraintAnchor: expected to be part of an environment, which knows the "
                    "action bounds, before use; append it with TransformedEnv(env, Compose(..., "
                    "this)), and to a replay buffer a clone() of an environment's own"
                )
            bounds = action_bounds(self.parent.full_action_spec, self.parent.action_key)
            self._low, self._high = bounds.low, bounds.high
        return Box(self._low, self._high, validate_args=False)
