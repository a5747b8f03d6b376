"""A constrained policy as one graph: geometry, anchor, network and flow, without a search."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.envs import GeometryTransform, leaf_specs, observed_entries, refuse_changed_inputs
from cnfp_torchrl.geometry import Box, ConstraintSet, Region, attempt_anchor, row_depths
from cnfp_torchrl.keys import ANCHOR_KEY, SAFE_ACTION_KEY
from cnfp_torchrl.modules import (
    ActionBounds,
    action_bounds,
    actor_modules,
    appended_transforms,
    constraint_bijectors,
    flow_head,
    refuse_misfit,
)

STEPS = 4
"""The number of steps inwards of the search for an anchor, as in `attempt_anchor`."""


class DeployedPolicy(nn.Module):
    """Map observations to allowed actions in a fixed number of operations, for export.

    The anchor is that of `cnfp_torchrl.geometry.attempt_anchor`: fixed-cost attempts in place of a
    search. Where they find a point that is deep enough in all sets, the action is *certified*: it
    lies in all of them. Elsewhere it is the *fallback*, which lies in the
    action bounds and about which nothing else is promised: by default the point with the most room
    in all sets that was tried, the middle of the bounds where there is none.

    Certified are only states with finite observations and valid sets. What eager geometry refuses
    with an error, such as NaN, is not certified here.

    Args:
        actor: A constrained actor.
        env: The environment of `constrain_env` that the actor is for, which knows the geometries;
            it is not stepped.
        stochastic: Whether the graph takes noise of N(0, 1), ``(B, d)``, as its last input; else
            the location takes the place of the sample.
        steps: The number of steps inwards of the attempts; more certify tighter states.
        fallback: The action of states that are not certified, such as one that brakes; None takes
            the default.

    Raises:
        TypeError: when the actor is not a constrained one.
        ValueError: when its flow guarantees nothing, when it is for other constraints or bounds
            than the environment's, when a constraint comes from no `GeometryTransform`, when a
            transform changes what geometry or network read, and for a fallback outside the bounds.
    """

    def __init__(
        self,
        actor: SafeProbabilisticTensorDictSequential,
        env: EnvBase,
        *,
        stochastic: bool = False,
        steps: int = STEPS,
        fallback: Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        head = flow_head(actor)
        if not head.flow.is_safe:
            raise ValueError(
                f"actor: expected a flow that guarantees the constraints, given "
                f"{type(head.flow).__name__}; take flow='exact'"
            )
        if steps < 0:
            raise ValueError(f"steps: expected a number >= 0, given {steps}")
        published = [bijector.name for bijector in constraint_bijectors(env)]
        if published != head.order:
            raise ValueError(
                f"actor: expected the environment's constraints {published}, given {head.order}; "
                "build it with constrain(actor, env)"
            )
        refuse_misfit(actor, action_bounds(env.full_action_spec, env.action_key), env.action_key)
        self.order = head.order
        self.stochastic, self.steps = stochastic, steps
        self.geometries: Any = nn.ModuleList(_geometries(env, head.order))
        self.body: Any = nn.ModuleList(actor_modules(actor)[:-1])
        self.flow = head.flow
        self.bijectors: Any = nn.ModuleList(head.bijectors)
        self.parameter_keys, self.action_dtype = head.parameter_keys, head.action_dtype
        self.bounds = ActionBounds(head.bounds)
        self.entries = observed_entries(env, self._read_keys())
        self.inputs = leaf_specs(self.entries)
        refuse_changed_inputs(env, self.input_keys)
        self.fallback = None if fallback is None else self._checked_fallback(fallback)
        self.eval()

    @property
    def noise_shape(self) -> tuple[int, ...]:
        """The shape of the noise for one state, ``(d,)``."""
        return (self.bounds.dim,)

    @property
    def input_keys(self) -> list[NestedKey]:
        """The keys of what is observed; a vector that `CatTensors` makes is read by its parts."""
        return list(self.inputs)

    def examples(self, batch: int) -> tuple[Tensor, ...]:
        """Return inputs of a batch size, zeros."""
        zeros = [spec.expand(batch, *spec.shape).zero() for spec in self.inputs.values()]
        if self.stochastic:
            zeros.append(torch.zeros(batch, *self.noise_shape, dtype=self.action_dtype))
        return tuple(zeros)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return actions ``(B, d)`` and which are certified, boolean ``(B,)``.

        Args:
            inputs: The entries of ``input_keys``, ``(B, *event)``, and noise if it is stochastic.
        """
        states = self.states(*inputs)
        bounds = self.bounds.on(inputs[0].device)
        # For each state: AOTInductor compiles no scalar constants, such as the width of one box.
        low, high = (end.expand(inputs[0].shape[0], -1) for end in (bounds.low, bounds.high))
        bounds = Box(low, high, validate_args=False)
        sets = self.sets(states)
        certified = _are_sound(inputs, sets)
        candidate = states.get(SAFE_ACTION_KEY, None)
        if candidate is not None:
            candidate = candidate.to(self.action_dtype)
        anchor, _ = attempt_anchor([bounds, *sets], candidate, self.steps)
        # Whether or not a better anchor exists, which attempts want to know: a deep one is safe.
        decided = _are_deep([bounds, *sets], anchor)
        self._publish(states, anchor, decided)
        for module in self.body:
            states = module(states)
        latent, scale = (states.get(key).to(self.action_dtype) for key in self.parameter_keys)
        if self.stochastic:
            latent = latent + scale * inputs[-1]
        region = Region((bounds, *sets), anchor, validate_args=False)
        action = self.flow(region)(latent)
        certified = certified & decided & action.isfinite().all(-1)
        fallback = self._fallback(bounds, anchor)
        return torch.where(certified.unsqueeze(-1), action, fallback), certified

    def states(self, *inputs: Tensor) -> TensorDictBase:
        """Return the states with the geometry that is published in them, unchecked."""
        states = TensorDict({}, batch_size=inputs[0].shape[:1])
        observed = dict(zip(self.inputs, inputs, strict=False))
        for entry in self.entries:
            states.set(entry.key, entry.value(lambda e: None if e.parts else observed[e.key]))
        for geometry in self.geometries:
            for key, value in geometry.entries(states).items():
                states.set(key, value)
        return states

    def sets(self, states: TensorDictBase) -> list[ConstraintSet]:
        """Return the constraints' sets in order of application, in the dtype of actions."""
        return [bijector.get_set(states).to(self.action_dtype) for bijector in self.bijectors]

    def _publish(self, states: TensorDictBase, anchor: Tensor, decided: Tensor) -> None:
        """Publish what a network may read of the anchor; it counts where all constraints hold."""
        states.set(ANCHOR_KEY, anchor)
        zero = anchor[..., 0] * 0
        for bijector in self.bijectors:
            states.set(bijector.active_key, decided)
            states.set(bijector.relaxation_key, zero)

    def _fallback(self, bounds: Box, anchor: Tensor) -> Tensor:
        inner = bounds.eroded(bounds.magnitude())
        if self.fallback is not None:
            return self.fallback.to(anchor).expand(anchor.shape)
        middle = ((inner.low + inner.high) / 2).expand(anchor.shape)
        inside = torch.minimum(torch.maximum(anchor, inner.low), inner.high)
        return torch.where(anchor.isfinite().all(-1, keepdim=True), inside, middle)

    def _checked_fallback(self, given: Sequence[float]) -> Tensor:
        bounds = self.bounds.on(None)
        action = torch.tensor(list(given), dtype=bounds.dtype)
        if action.shape != bounds.low.shape or not bool(bounds.contains(action)):
            raise ValueError(
                f"fallback: expected an action of {bounds.dim} components within the action "
                f"bounds, low {bounds.low.tolist()} and high {bounds.high.tolist()}, given "
                f"{list(given)}"
            )
        return action

    def _read_keys(self) -> list[NestedKey]:
        """Return what geometries and network read and nothing in the graph writes."""
        keys: list[NestedKey] = []
        for geometry in self.geometries:
            keys += geometry.in_keys
        written: set[NestedKey] = set()
        for module in self.body:
            keys += [key for key in module.in_keys if key not in written]
            written |= set(module.out_keys)
        return keys


def _geometries(env: EnvBase, order: Sequence[str]) -> list[GeometryTransform]:
    transforms = appended_transforms(env)
    found = [transform for transform in transforms if isinstance(transform, GeometryTransform)]
    if missing := set(order) - {transform.name for transform in found}:
        raise ValueError(
            f"env: expected a GeometryTransform for each constraint, given none for "
            f"{sorted(missing)}"
        )
    return [transform for transform in found if transform.name in order]


def _are_deep(sets: Sequence[ConstraintSet], anchor: Tensor) -> Tensor:
    """Tell which points have the depth of an anchor in all rows of all sets, ``(B,)``."""
    deep = anchor.isfinite().all(-1)
    for constraint_set, depth in zip(sets, row_depths(sets), strict=True):
        deep = deep & (constraint_set.row_slacks(anchor) >= depth).all(-1)
    return deep


def _are_sound(inputs: Sequence[Tensor], sets: Sequence[ConstraintSet]) -> Tensor:
    """Tell where inputs are finite and sets valid, ``(B,)``."""
    bad: list[Any] = [~value.isfinite() for value in inputs if value.is_floating_point()]
    for constraint_set in sets:
        bad += [value.isnan() for value in constraint_set.fields().values()]
        bad += [mask for _, mask, _ in constraint_set.invalid_fields()]
    sound = torch.ones_like(inputs[0].flatten(1)[:, 0], dtype=torch.bool)
    for mask in bad:
        sound = sound & ~(mask.flatten(1).any(-1) if mask.ndim > 1 else mask)
    return sound
