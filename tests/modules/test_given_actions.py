"""Densities of given actions: an actor's own at saturation, and demonstrations."""

import copy
import warnings
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.envs import TransformedEnv
from torchrl.modules import ValueOperator
from torchrl.objectives import ClipPPOLoss

from cnfp_torchrl.bijectors import well_inside
from cnfp_torchrl.distributions import ConstrainedFlow
from cnfp_torchrl.modules import LostDensityWarning, flow_head, split_at_latent
from tests.point_nav import STATES, make_actor

FLOWS = ["exact", "gauge", "radial", "unconstrained"]
DEPTH = 1e-3


class Saturated(nn.Module):
    """A network that wants the corner."""

    def __init__(self) -> None:
        super().__init__()
        self.mean = nn.Parameter(torch.tensor([12.0, -12.0]))

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean = self.mean.expand(*observation.shape[:-1], 2)
        return mean, torch.ones_like(mean)


def distribution(actor: Any, state: TensorDictBase) -> ConstrainedFlow:
    acting = state.clone()
    for module in actor.module[:-1]:
        acting = module(acting)
    return flow_head(actor).get_dist(acting)


# Demonstrations -----------------------------------------------------------------------------------


@pytest.mark.parametrize("flow", FLOWS)
def test_inside_it_is_the_density_itself(state: TensorDictBase, flow: str) -> None:
    dist = distribution(make_actor(flow=flow), state)
    action = well_inside(dist.bijector, dist.sample((50,)), 0.1)
    scored = dist.nearest_log_prob(action, DEPTH)
    assert torch.equal(scored.action, action)
    assert (scored.moved == 0).all()
    torch.testing.assert_close(scored.log_prob, dist.log_prob(action))


@pytest.mark.parametrize("flow", FLOWS)
@pytest.mark.parametrize("beyond", [1.0, 1.0 + 1e-6, 1.5, 1e6])
def test_on_and_beyond_the_boundary_it_is_finite(
    state: TensorDictBase, flow: str, beyond: float
) -> None:
    actor = make_actor(flow=flow)
    dist = distribution(actor, state)
    anchor = state["constraints", "anchor"] if flow != "unconstrained" else torch.zeros(2)
    directions = torch.randn(200, len(STATES), 2)
    edge = well_inside(dist.bijector, anchor + 1e3 * directions, 1e-6)
    given = anchor + beyond * (edge - anchor)
    scored = dist.nearest_log_prob(given, DEPTH)
    assert scored.log_prob.isfinite().all()
    # On the way from the anchor, a thousandth of it before the end: no farther than that. The
    # rounding of the given actions shows where they are far.
    way = torch.linalg.vector_norm(given - anchor, dim=-1)
    assert (scored.moved <= (1 - (1 - DEPTH) / beyond) * way + 1e-5 * beyond).all()
    inside = dist.bijector.contains(scored.action)
    assert inside.all()
    scored.log_prob.mean().backward()
    gradients = [parameter.grad for parameter in actor.parameters()]
    assert all(gradient.isfinite().all() for gradient in gradients)
    assert any(gradient.abs().max() > 0 for gradient in gradients)


def test_a_chain_is_pulled_in_without_an_anchor(state: TensorDictBase) -> None:
    dist = distribution(make_actor(flow="squash"), state)
    scored = dist.nearest_log_prob(torch.full((len(STATES), 2), 0.9))
    assert scored.log_prob.isfinite().all()
    assert (scored.moved > 0).any()


def test_cloning_of_demonstrations_on_the_boundary_learns(state: TensorDictBase) -> None:
    actor = make_actor(flow="exact")
    with torch.no_grad():
        expert = distribution(make_actor(Saturated()), state).deterministic_sample
    optimizer = torch.optim.Adam(actor.parameters(), lr=1e-2)
    losses = []
    for _ in range(60):
        loss = -distribution(actor, state).nearest_log_prob(expert).log_prob.mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert torch.tensor(losses).isfinite().all()
    assert losses[-1] < losses[0] - 1


@pytest.mark.parametrize("depth", [0.0, 1.0, -0.1])
def test_a_bad_depth_is_refused(state: TensorDictBase, depth: float) -> None:
    with pytest.raises(ValueError, match="depth: expected a share between 0 and 1, given"):
        distribution(make_actor(), state).nearest_log_prob(torch.zeros(8, 2), depth)


@pytest.mark.parametrize(
    "given", [torch.zeros(8, 3), torch.zeros(7, 2), torch.zeros(8, 2).long()], ids=["d", "n", "int"]
)
def test_actions_of_another_shape_or_dtype_are_refused(
    state: TensorDictBase, given: torch.Tensor
) -> None:
    with pytest.raises(ValueError, match="value: expected floating actions"):
        distribution(make_actor(), state).nearest_log_prob(given)


def test_what_is_not_finite_is_refused(state: TensorDictBase) -> None:
    given = torch.zeros(8, 2)
    given[3, 1] = torch.nan
    with pytest.raises(ValueError, match=r"value at index \[3, 1\]: .*given nan"):
        distribution(make_actor(), state).nearest_log_prob(given)


# The actor's own ----------------------------------------------------------------------------------


def collected(env: TransformedEnv, policy: Any) -> TensorDictBase:
    with torch.no_grad():
        batch = env.rollout(3, policy, break_when_any_done=False).reshape(-1)
    batch["advantage"] = torch.ones(len(batch), 1)
    batch["value_target"] = torch.zeros(len(batch), 1)
    return batch


def ppo(actor: Any) -> ClipPPOLoss:
    value = ValueOperator(nn.Linear(5, 1), in_keys=["observation"])
    return ClipPPOLoss(actor, value, entropy_bonus=False)


def test_ppo_on_a_plain_actor_warns_once_and_names_the_remedy(env: TransformedEnv) -> None:
    actor = make_actor(Saturated(), return_log_prob=True)
    batch = collected(env, actor)
    loss = ppo(actor)
    with pytest.warns(LostDensityWarning, match="split_at_latent"):
        loss(batch.clone())
    loss(batch.clone())  # any warning is an error here


def test_ppo_on_the_latents_does_not_warn(env: TransformedEnv) -> None:
    policy, base = split_at_latent(make_actor(Saturated()))
    batch = collected(env, policy)
    with warnings.catch_warnings():
        warnings.simplefilter("error", LostDensityWarning)
        assert ppo(base)(batch)["loss_objective"].isfinite()


def test_actions_of_others_far_outside_are_no_reason_to_warn(state: TensorDictBase) -> None:
    dist = distribution(make_actor(), state)
    assert dist.log_prob(torch.full((8, 2), 5.0)).isneginf().all()


def test_an_actor_that_has_warned_can_be_copied() -> None:
    copy.deepcopy(make_actor())
