"""The transform that finds, once per state, the anchor of the allowed region."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from itertools import dropwhile, takewhile
from typing import Any, Self

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.data import Binary, Composite, TensorSpec, Unbounded
from torchrl.envs import FrameSkipTransform, MultiAction, NoopResetEnv, Transform

from cnfp_torchrl.envs.geometry_transform import GeometryTransform, write_entries
from cnfp_torchrl.envs.relaxation_watch import RelaxationWatch
from cnfp_torchrl.envs.step_geometry import StepGeometry, anchor_entries
from cnfp_torchrl.geometry import LEEWAY, Box, finish_anchor
from cnfp_torchrl.keys import ANCHOR_KEY
from cnfp_torchrl.modules import (
    ActionBounds,
    ConstraintBijector,
    ConstraintPublisher,
    action_bounds,
    appended_transforms,
    in_order,
    refuse_misfit,
)

UNSEEN_STEPS = (FrameSkipTransform, MultiAction, NoopResetEnv)
"""TorchRL's transforms that take several steps of an environment for one of their own."""


def _no_policy() -> None:
    return None


class ConstraintAnchor(Transform, ConstraintPublisher):
    """Publish the anchor of the allowed region and which constraints hold, for exact flows.

    Reads the sets that the geometry transforms before it publish, and a candidate at
    ``("constraints", "safe_action")`` if there is one: a known safe action makes the anchor cheap.
    It is checked; where it fails, the general method decides
    (`cnfp_torchrl.geometry.lexicographic_anchor`).

    Writes ``("constraints", "anchor")``, ``(*batch, d)``, and of each constraint

    - ``("constraints", NAME, "active")``, boolean ``(*batch,)``: False where it cannot hold
      together with those of higher priority,
    - ``("constraints", NAME, "relaxation")``, ``(*batch,)``: by how much it is widened there, in
      units of its slack; 0 where it is active, infinite where it had to be dropped,
    - ``("constraints", NAME, "row_relaxation")``, ``(*batch, m)``: the same row by row, if its
      family has rows.

    A constraint that gives way in each state of the first larger batches (of 256 states, or as many
    of smaller ones) is warned of, once (`RelaxedEverywhereWarning`).

    A collector whose policy is a constrained actor for other action bounds, or one that explores
    behind its flow, is refused when it is made: at its first reset. Not so where this transform
    runs in the workers of a batched environment, which know no collector.

    Args:
        bijectors: One for each constraint; they know where the geometry lies.
        order: The constraints' names in order of application, the last with the highest priority;
            None takes the bijectors' own order. The same as the flow's.
        leeway: The amount by which relaxed constraints give way beyond the least amount, as a share
            of the smallest width of the action bounds.
        compile: Whether the geometries right before this transform, their checks and the cheap part
            of the anchor are compiled into one function (`torch.compile`), which steps use; resets
            do without. `constraint_set` must then read the entries of its `in_keys` alone.

    Raises:
        TypeError: when a bijector is none, or the order is a string; at a reset, for a collector's
            policy that explores behind its flow.
        ValueError: when an order does not name each constraint exactly once; at a reset, for a
            collector's policy with other action bounds.
    """

    states_order = True

    def __init__(
        self,
        bijectors: Sequence[ConstraintBijector],
        order: Sequence[str] | None = None,
        leeway: float = LEEWAY,
        *,
        compile: bool = False,
    ) -> None:
        super().__init__()
        self._leeway = leeway
        self._bijectors = in_order(bijectors, order)
        self._watch = RelaxationWatch([bijector.name for bijector in self._bijectors], leeway)
        # Read from the parent once; a module, to move with the environment.
        self._bounds: ActionBounds | None = None
        self._compiles = compile
        # In use between resets; kept for the next episode, because it may take long to compile.
        self._geometry: StepGeometry | None = None
        self._known_geometry: StepGeometry | None = None
        # The last policy of a collector that was found to fit: each is examined once.
        self._fitting: Callable[[], nn.Module | None] = _no_policy

    @property
    def leeway(self) -> float:
        """By how much relaxed constraints give way beyond the least amount."""
        return self._leeway

    @property
    def bijectors(self) -> list[ConstraintBijector]:
        """One for each constraint, in order of application."""
        return list(self._bijectors)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        batch, bounds, geometry = next_tensordict.batch_size, self._action_bounds(), self._geometry
        if geometry is None:
            geometry = StepGeometry([], self._bijectors, bounds)
        elif geometry.bounds is not bounds:  # moved to another device
            geometry = self._take_over()
        step = geometry(next_tensordict)
        if step.is_decided:
            self._watch.all_held(batch.numel())
            if step.is_published:
                return next_tensordict
            found = step.begun.all_held()
        else:
            found = finish_anchor(step.begun, self._leeway)
            if self._watch.looks and bool(found.active.all()):
                self._watch.all_held(batch.numel())
            else:
                self._watch(step.begun.sets, found.largest(), batch.numel())
        write_entries(next_tensordict, anchor_entries(found, self._bijectors, batch))
        return next_tensordict

    def _take_over(self) -> StepGeometry:
        """From now on publish in one pass what the geometries right before this transform do."""
        geometries = self._geometries_before()
        for geometry in geometries:
            geometry.is_published_by_another = True
        known, bounds = self._known_geometry, self._action_bounds()
        if known is None or known.geometries != geometries or known.bounds is not bounds:
            known = StepGeometry(geometries, self._bijectors, bounds, compile=self._compiles)
        self._geometry = self._known_geometry = known
        return known

    def publishes_for(self, other: ConstraintPublisher) -> bool:
        """Tell whether another transform can leave it to this one to publish its constraint."""
        # All geometries or none, as one may read what another publishes.
        geometries = self._geometries_before()
        return other in geometries and all(g.is_published_by_another for g in geometries)

    def _geometries_before(self) -> list[GeometryTransform]:
        """Return the geometries right before this transform, in order."""
        appended = appended_transforms(self.container)
        before = reversed(list(takewhile(lambda transform: transform is not self, appended)))
        return list(takewhile(lambda t: isinstance(t, GeometryTransform), before))[::-1]

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self._refuse_unseen_steps()
        self._refuse_misfit_of_collector()
        left = [g for g in self._geometries_before() if g.is_published_by_another]
        self._geometry = StepGeometry(left, self._bijectors, self._action_bounds())
        reset = self._call(tensordict_reset)
        self._take_over()
        return reset

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Fill in anchor and flags of stored transitions, at root and under next."""
        # In a replay buffer the geometries publish their sets themselves. An environment may be in
        # the middle of an episode, and goes on as before.
        before, self._geometry = self._geometry, None
        try:
            self._call(tensordict)
            if "next" in tensordict.keys():  # noqa: SIM118 - a tensordict iterates over its batch
                self._call(tensordict.get("next"))
        finally:
            self._geometry = before
        return tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the anchor and the flags."""
        assert isinstance(observation_spec, Composite)
        bounds, batch = self._action_bounds(), observation_spec.shape
        state = observation_spec.zero()
        observation_spec[ANCHOR_KEY] = Unbounded(
            (*batch, bounds.dim), dtype=bounds.dtype, device=observation_spec.device
        )
        for bijector in self._bijectors:
            observation_spec[bijector.active_key] = Binary(
                shape=batch, dtype=torch.bool, device=observation_spec.device
            )
            observation_spec[bijector.relaxation_key] = Unbounded(
                batch, dtype=bounds.dtype, device=observation_spec.device
            )
            if bijector.row_relaxation_key is not None:
                slacks = bijector.get_set(state).row_slacks(bounds.low)
                observation_spec[bijector.row_relaxation_key] = Unbounded(
                    (*batch, slacks.shape[-1]), dtype=bounds.dtype, device=observation_spec.device
                )
        return observation_spec

    def _refuse_unseen_steps(self) -> None:
        """Refuse transforms behind this one that act in states for which it published nothing."""
        after = dropwhile(
            lambda transform: transform is not self, appended_transforms(self.container)
        )
        for transform in after:
            if isinstance(transform, UNSEEN_STEPS):
                kind = type(transform).__name__
                raise ValueError(
                    f"{kind}: expected inside the environment that is constrained, "
                    "given one around it, which executes actions in states for which nobody asked "
                    "what they allow; write constrain_env(TransformedEnv(env, "
                    f"{kind}(...)), ...), whose geometry must hold for all steps of "
                    "one action"
                )

    def _refuse_misfit_of_collector(self) -> None:
        """Refuse the policy of the collector that resets the environment, as it does when made.

        Policies of other loops are out of sight.
        """
        collector = self.collector
        policy = getattr(collector, "policy", None)
        if not isinstance(policy, nn.Module) or policy is self._fitting():
            return
        refuse_misfit(policy, self._action_bounds(), self.parent.action_key)
        self._fitting = weakref.ref(policy)

    def __getstate__(self) -> dict[str, Any]:
        alone = {"_fitting": _no_policy, "_geometry": None, "_known_geometry": None}
        return {**super().__getstate__(), **alone}

    def clone(self) -> Self:
        """Return a copy without environment, which keeps the action bounds of this one's."""
        if self.parent is not None:
            self._action_bounds()
        copy = super().clone()
        copy._geometry = copy._known_geometry = None
        return copy

    def _action_bounds(self, device: torch.device | None = None) -> Box:
        if self._bounds is None:
            if self.parent is None:
                raise RuntimeError(
                    "ConstraintAnchor: expected to be part of an environment, which knows the "
                    "action bounds, before use; append it with TransformedEnv(env, Compose(..., "
                    "this)), and to a replay buffer a clone() of an environment's own"
                )
            bounds = action_bounds(self.parent.full_action_spec, self.parent.action_key)
            self._bounds = ActionBounds(bounds)
        return self._bounds.on(device)
