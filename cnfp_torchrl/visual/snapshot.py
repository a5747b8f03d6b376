"""Everything that happens inside a flow policy in one state, as plain tensors on the host."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.distributions import Independent, Normal
from torch.linalg import vector_norm
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.bijectors import Bijector, BoxSquash, Stages, has_latent
from cnfp_torchrl.geometry import Region
from cnfp_torchrl.keys import ANCHOR_KEY
from cnfp_torchrl.modules import ConstrainedFlowModule, Flow, flow_head

_SATURATED = 0.01
"""Of the action bounds: samples that spread less in each component lie in a point of a picture."""


@dataclass(frozen=True)
class Stage:
    """What one stage of a flow made of the base samples.

    Args:
        name: The name of the constraint, or ``bounds``.
        samples: The samples, ``(n, d)``.
        log_density: The log-density of those samples in the distribution after this stage,
            ``(n,)``.
        applied: The indices into the region's sets of those applied so far, this one last.
        relaxation: The amount by which the constraint's set had to be widened to hold in this
            state; infinite for one that is dropped and changes nothing.
    """

    name: str
    samples: Tensor
    log_density: Tensor
    applied: tuple[int, ...]
    relaxation: float

    @property
    def active(self) -> bool:
        """Whether the constraint holds in this state as it is stated."""
        return self.relaxation == 0


@dataclass(frozen=True)
class FlowSnapshot:
    """A flow policy in one state: base samples, what each stage makes of them, and the sets.

    The first sample is the executed one, and its path is followed unless another is chosen.

    Args:
        state: The state, as the actor saw it, of batch size ``()``.
        loc: The location of the Gaussian base, ``(d,)``.
        scale: The scale of the Gaussian base, ``(d,)``.
        latents: The base samples, ``(n, d)``.
        latent_log_density: The log-density of the base samples, ``(n,)``.
        stages: The stages in order of application.
        region: The sets as they are applied in this state, widened where they are relaxed
            (``sets[0]`` the action bounds), anchor, and which sets are not dropped.
        relaxation: The amount by which each of its sets is widened; infinite where it is dropped.
        through_stages: A map of further latents ``(n, d)`` to actions ``(stages, n, d)`` and
            log-densities ``(stages, n)``.
        log_densities: The log-densities of further actions ``(n, d)`` after each stage, ``(stages,
            n)``; -inf where there is none.
        head: The policy's flow module.
        followed: The index of the sample whose path through the stages is drawn.
        is_recovered: Whether the path of an executed action is known; an action outside the flow's
            support, which another policy may have taken, has none and seems to stand still.
    """

    state: TensorDictBase
    loc: Tensor
    scale: Tensor
    latents: Tensor
    latent_log_density: Tensor
    stages: tuple[Stage, ...]
    region: Region
    relaxation: tuple[float, ...]
    through_stages: Callable[[Tensor], tuple[Tensor, Tensor]]
    log_densities: Callable[[Tensor], Tensor]
    head: ConstrainedFlowModule
    followed: int = 0
    is_recovered: bool = True

    @property
    def constraint_names(self) -> tuple[str, ...]:
        """The names of ``region.sets[1:]``, in order of application."""
        return tuple(self.head.order)

    @property
    def is_safe(self) -> bool:
        """Whether the flow drops what cannot hold and keeps everything else."""
        return self.head.flow.is_safe

    @property
    def dim(self) -> int:
        """The dimension d of the action space."""
        return int(self.latents.shape[-1])

    @property
    def dropped(self) -> tuple[str, ...]:
        """The constraints that cannot hold together with those of higher priority here."""
        return tuple(n for k, n in enumerate(self.constraint_names, 1) if not self.is_active(k))

    def is_active(self, index: int) -> bool:
        """Tell whether ``region.sets[index]`` is applied in this state, as stated or relaxed."""
        return bool(self.region.is_active[index])

    @cached_property
    def contained(self) -> Tensor:
        """Which samples of the last stage each set contains, dropped ones too, ``(K + 1, n)``."""
        samples = self.stages[-1].samples
        return torch.stack([allowed.contains(samples) for allowed in self.region.sets])

    @cached_property
    def share_allowed_before(self) -> float:
        """The share of the samples, squashed into the bounds, that every applied set contains."""
        squash = BoxSquash.onto(self.region.bounds)
        bounded, _ = squash.forward_and_log_det(self.latents)
        allowed = torch.ones(len(bounded), dtype=torch.bool)
        for k, constraint in enumerate(self.region.sets[1:], start=1):
            if self.is_active(k):
                allowed &= constraint.contains(bounded)
        return float(allowed.double().mean())

    def outside(self, stage: int) -> Tensor:
        """Tell, with zero tolerance, which samples lie outside the active sets so far, ``(n,)``.

        After the last stage, whose samples are executed, every set counts, applied or not.
        """
        if stage + 1 == len(self.stages):
            active = [k for k in range(len(self.region.sets)) if self.is_active(k)]
            return ~self.contained[active].all(0)
        samples = self.stages[stage].samples
        outside = torch.zeros(samples.shape[:-1], dtype=torch.bool)
        for index in self.stages[stage].applied:
            if self.is_active(index):
                outside |= ~self.region.sets[index].contains(samples)
        return outside

    def path(self) -> Tensor:
        """Return the followed sample after each stage, ``(stages, d)``."""
        return torch.stack([stage.samples[self.followed] for stage in self.stages])

    @property
    def is_saturated(self) -> bool:
        """Whether the samples hardly differ once squashed into the bounds, and show little."""
        bounds = self.region.bounds
        squashed, _ = BoxSquash.onto(bounds).forward_and_log_det(self.latents)
        spread = squashed.std(0) / (bounds.high - bounds.low)
        return bool((spread < _SATURATED).all())

    def with_standard_base(self, seed: int = 0) -> FlowSnapshot:
        """Return what the flow does in the same state to samples of the standard Gaussian."""
        zeros = torch.zeros_like(self.loc)
        loc, scale = self.head.parameter_keys
        state = self.state.clone().set(loc, zeros).set(scale, torch.ones_like(zeros))
        generator = torch.Generator().manual_seed(seed)
        noise = torch.randn(self.latents.shape, generator=generator)
        return snapshot_of(self.head, state, noise)

    def following_the_longest_path(self) -> FlowSnapshot:
        """Return the same snapshot, following the sample that the stages move farthest."""
        ways = torch.stack([stage.samples for stage in self.stages]).diff(dim=0)
        return replace(self, followed=int(vector_norm(ways, dim=-1).sum(0).argmax()))


@torch.no_grad()
def take_snapshot(
    actor: SafeProbabilisticTensorDictSequential,
    state: TensorDictBase,
    *,
    samples: int = 800,
    seed: int = 0,
) -> FlowSnapshot:
    """Return what a constrained actor does in one state.

    Args:
        actor: A constrained actor, from `make_constrained_actor` or `constrain`.
        state: A state of batch size ``()``, with geometry, anchor and active flags; not changed.
        samples: The number of base samples.
        seed: The seed of those; torch's global generator is left alone.

    Raises:
        ValueError: when the state is a batch.
    """
    if state.batch_size != torch.Size():
        raise ValueError(
            f"state: expected one state (batch size ()), given {tuple(state.batch_size)}; index it"
        )
    # The actor's own sampling must not advance the generator of a training run that goes on.
    with torch.random.fork_rng(devices=[]):
        state = actor(state.clone())
    head = flow_head(actor)
    loc = state.get(head.parameter_keys[0])
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(samples, loc.shape[-1], generator=generator)
    return snapshot_of(head, state, noise)


def snapshot_of(head: ConstrainedFlowModule, state: TensorDictBase, noise: Tensor) -> FlowSnapshot:
    """Return the snapshot of a state in which a policy has written its Gaussian.

    Args:
        head: The flow module of the policy.
        state: A state of batch size ``()``, with location, scale and geometry; where anchor and
            active flags are missing, which only exact flows need, they are computed here.
        noise: Noise of the standard Gaussian, ``(n, d)``.
    """
    loc, scale = (state.get(key) for key in head.parameter_keys)
    base = Independent(Normal(loc, scale, validate_args=False), 1, validate_args=False)
    region, relaxation = _as_applied(head, state)
    applied = _applied(head.stage_names, head.order)
    staged = StagedFlow(head.flow, region, [sets for _, sets in applied])

    @torch.no_grad()
    def through_stages(latents: Tensor) -> tuple[Tensor, Tensor]:
        given = latents.to(loc)
        actions, log_dets = staged.forward(given)
        return actions.cpu(), (base.log_prob(given) - log_dets).cpu()

    @torch.no_grad()
    def log_densities(actions: Tensor) -> Tensor:
        latents, log_dets = staged.inverse(actions.to(loc))
        outside = ~has_latent(latents, log_dets)
        return (base.log_prob(latents) + log_dets).masked_fill(outside, -torch.inf).cpu()

    latents = loc + scale * noise.to(loc)
    latent_log_density = base.log_prob(latents).cpu()
    actions, log_dets = (values.cpu() for values in staged.forward(latents))
    on_host = region.to(device="cpu")
    stages = tuple(
        Stage(
            name,
            actions[i],
            latent_log_density - log_dets[i],
            sets,
            relaxation[sets[-1]],
        )
        for i, (name, sets) in enumerate(applied)
    )
    return FlowSnapshot(
        state=state if loc.device.type == "cpu" else state.cpu(),
        loc=loc.cpu(),
        scale=scale.cpu(),
        latents=latents.cpu(),
        latent_log_density=latent_log_density,
        stages=stages,
        region=on_host,
        relaxation=relaxation,
        through_stages=through_stages,
        log_densities=log_densities,
        head=head,
    )


def _as_applied(
    head: ConstrainedFlowModule, state: TensorDictBase
) -> tuple[Region, tuple[float, ...]]:
    """Return the region of a state with sets as the flow applies them, and their relaxations.

    The anchor, which only exact flows make the environment find, is looked for where it is missing.
    """
    if state.get(ANCHOR_KEY, None) is not None:
        region = head.get_region(state)
    else:
        region = Region.build(
            [head.bounds, *(bijector.get_set(state) for bijector in head.bijectors)]
        )
    active = [True] * len(region.sets) if region.active is None else region.active.tolist()
    sets, relaxation = list(region.sets), [0.0 if flag else torch.inf for flag in active]
    if head.flow.is_safe and region.relaxation is not None:
        for k, amounts in enumerate(region.relaxation):
            if not active[k] and sets[k].can_be_inflated() and bool(amounts.isfinite().all()):
                sets[k], relaxation[k] = sets[k].inflated(amounts), float(amounts.amax())
    holds = torch.tensor([x < torch.inf for x in relaxation], device=region.anchor.device)
    return Region(tuple(sets), region.anchor, holds), tuple(relaxation)


def _applied(stages: list[str], order: list[str]) -> list[tuple[str, tuple[int, ...]]]:
    """Return each stage's name with the indices of the sets applied so far."""
    index = {"bounds": 0} | {name: k for k, name in enumerate(order, 1)}
    return [(name, tuple(index[n] for n in stages[: i + 1])) for i, name in enumerate(stages)]


class StagedFlow:
    """The bijectors of a flow up to each of its stages.

    Args:
        flow: The way in which the sets are combined.
        region: The region of one state.
        applied: The indices, for each stage, into the region's sets of those applied so far.
    """

    def __init__(self, flow: Flow, region: Region, applied: Sequence[Sequence[int]]) -> None:
        self._count = len(applied)
        self._is_one = flow.is_safe and flow.has_density
        self._bijectors: list[Bijector]
        if self._is_one:
            # To an exact flow, a set not yet applied is one that is not active.
            holds = torch.tensor(
                [[k in so_far for k in range(len(region.sets))] for so_far in applied],
                device=region.anchor.device,
            )
            active = holds if region.active is None else holds & region.active
            self._bijectors = [flow(Region(region.sets, region.anchor, active.unsqueeze(1)))]
        else:
            self._bijectors = [stage_bijector(flow, region, so_far) for so_far in applied]

    @property
    def last(self) -> Bijector:
        """The bijector up to the last stage, of an exact flow all of them at once."""
        return self._bijectors[-1]

    def forward(self, latents: Tensor) -> Stages:
        """Return the actions of latents ``(n, d)`` after each stage, ``(stages, n, d)``."""
        if self._is_one:
            return self._each_stage(*self.last.forward_and_log_det(latents))
        return self.last.stages(latents)

    def inverse(self, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return latents ``(stages, n, d)`` that become actions ``(n, d)``, and log-determinants.

        The log-determinants ``(stages, n)`` are those of the maps from actions to latents.
        """
        if self._is_one:
            return self._each_stage(*self.last.inverse_and_log_det(actions))
        found = [bijector.inverse_and_log_det(actions) for bijector in self._bijectors]
        latents, log_dets = zip(*found, strict=True)
        return torch.stack(latents), torch.stack(log_dets)

    def _each_stage(self, points: Tensor, log_dets: Tensor) -> Stages:
        # What no constraint has a part in has no stages of its own.
        shape = (self._count, *points.shape[-2:])
        return Stages(points.expand(shape), log_dets.expand(shape[:-1]))


def stage_bijector(flow: Flow, region: Region, applied: Sequence[int]) -> Bijector:
    """Return the bijector of a flow up to a stage.

    Args:
        flow: The way in which the sets are combined.
        region: The region of one state.
        applied: The indices into the region's sets of those applied so far.
    """
    chosen = [0, *(k for k in applied if k > 0)]
    active = None if region.active is None else region.active[..., chosen]
    return flow(Region([region.sets[k] for k in chosen], region.anchor, active))
