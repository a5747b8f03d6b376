"""What a flow policy did in a recorded step: the executed action's way through the stages."""

from __future__ import annotations

from dataclasses import replace

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.distributions import Independent, Normal
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.bijectors import SquashChain, has_latent
from cnfp_torchrl.keys import require
from cnfp_torchrl.modules import flow_head
from cnfp_torchrl.visual.snapshot import FlowSnapshot, StagedFlow, snapshot_of


@torch.no_grad()
def replay_step(
    actor: SafeProbabilisticTensorDictSequential, transition: TensorDictBase, noise: Tensor
) -> FlowSnapshot:
    """Return what a constrained actor did in one recorded step; sample 0 is the executed action.

    The Gaussian is the recorded one where the policy wrote it: in a warm-up it is not the
    network's. The way of the executed action is found by inverting the flow in float64, whose sets
    are eroded less than those of float32, so that saturated actions have a latent, too. After the
    last stage stands the recorded action, bit by bit.

    Args:
        actor: A constrained actor, from `make_constrained_actor` or `constrain`.
        transition: A transition of batch size ``()``, with geometry and action; not changed.
        noise: Noise of the standard Gaussian, ``(n, d)``, for the other samples.

    Raises:
        ValueError: when the transition is a batch.
        MissingGeometryError: when the action or geometry is missing.
    """
    if transition.batch_size != torch.Size():
        raise ValueError(
            "transition: expected one step (batch size ()), given "
            f"{tuple(transition.batch_size)}; index it"
        )
    head = flow_head(actor)
    state = transition.exclude("next")
    action = require(state, head.action_key, "replay steps that a policy has taken").detach()
    if any(state.get(key, None) is None for key in head.parameter_keys):
        # Drawing an action must not advance the generator of a training run that goes on.
        with torch.random.fork_rng(devices=[]):
            state = actor(state.clone()).set(head.action_key, action)
    return _with_executed(snapshot_of(head, state, noise), action.cpu())


def _with_executed(snapshot: FlowSnapshot, action: Tensor) -> FlowSnapshot:
    """Return the snapshot with the executed action before all samples."""
    region = snapshot.region.to(torch.float64)
    staged = StagedFlow(snapshot.head.flow, region, [stage.applied for stage in snapshot.stages])
    given = action.double()
    latents, inverse_log_dets = staged.inverse(given[None])
    latent, inverse_log_det = latents[-1], inverse_log_dets[-1]
    path, log_dets = staged.forward(latent)
    path = path.squeeze(1)
    if isinstance(staged.last, SquashChain):
        path = _backwards(staged.last, given)
    normal = Normal(snapshot.loc.double(), snapshot.scale.double(), validate_args=False)
    latent_log_density = Independent(normal, 1, validate_args=False).log_prob(latent)
    is_recovered = bool(path.isfinite().all())
    if not is_recovered:
        path = given.expand(len(snapshot.stages), -1)
    path = torch.cat([path[:-1], given[None]])
    samples = _before(path[:, None], torch.stack([stage.samples for stage in snapshot.stages]))
    # A saturated action has lost its latent: as the distribution does, take the density's limit.
    of_action = (latent_log_density - log_dets).masked_fill(
        ~has_latent(latent, inverse_log_det), -torch.inf
    )
    log_density = _before(of_action, torch.stack([stage.log_density for stage in snapshot.stages]))
    stages = tuple(
        replace(stage, samples=samples[i], log_density=log_density[i])
        for i, stage in enumerate(snapshot.stages)
    )
    return replace(
        snapshot,
        latents=_before(latent, snapshot.latents, 0),
        latent_log_density=_before(latent_log_density, snapshot.latent_log_density, 0),
        stages=stages,
        is_recovered=is_recovered,
    )


def _backwards(chain: SquashChain, action: Tensor) -> Tensor:
    """Return where an action was after each member of a chain, without passing through the latent.

    A squash before the last one may be saturated, where the latent is lost to rounding but the
    actions in between are not.
    """
    points = [action]
    for member in reversed(chain.bijectors[1:]):
        points.append(member.inverse_and_log_det(points[-1])[0])
    return torch.stack(points[::-1])


def _before(first: Tensor, rest: Tensor, dim: int = 1) -> Tensor:
    return torch.cat([first.to(rest), rest], dim)
