"""Constrained actors cut at the latent: exact ratios, shared networks, noise that stays allowed."""

import re
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import InteractionType, TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Unbounded
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, AdditiveGaussianModule, ValueOperator
from torchrl.objectives import ClipPPOLoss, KLPENPPOLoss

from cnfp_torchrl.modules import (
    FlowMap,
    LostDensityWarning,
    MissingGeometryError,
    constrain,
    flow_head,
    split_at_latent,
    with_reference_entropy,
)
from tests.copies import EVERY_COPY
from tests.point_nav import inside, make_actor, make_tanh_actor


class Gaussian(nn.Module):
    """A network whose location is the given one everywhere, plus a little of the observation."""

    def __init__(self, loc: float, scale: float) -> None:
        super().__init__()
        self.loc = nn.Parameter(torch.tensor([loc, -loc]))
        self.log_scale = nn.Parameter(torch.full((2,), scale).log())
        self.mix = nn.Linear(5, 2)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        loc = self.loc + 0.1 * self.mix(observation)
        return loc, self.log_scale.exp().expand_as(loc)


def many(state: TensorDictBase, copies: int) -> TensorDictBase:
    return state.expand(copies, *state.shape).reshape(-1).clone()


def with_advantages(steps: TensorDictBase) -> TensorDictBase:
    column = torch.randn(len(steps), 1)
    return steps.copy().update({"advantage": column, "value_target": column.clone()})


@pytest.fixture
def critic() -> ValueOperator:
    return ValueOperator(MLP(5, 1, num_cells=[8]), in_keys=["observation"])


# The policy


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_policy_stores_latents_and_acts_on_them(scale: float, state: TensorDictBase) -> None:
    actor = make_actor(Gaussian(0.3, scale))
    policy = split_at_latent(actor).policy
    with torch.no_grad():
        steps = policy(many(state, 64))
    for name, good in inside(steps).items():
        assert bool(good.all()), name
    again = flow_head(actor).get_bijector(steps)(steps["latent"])
    torch.testing.assert_close(steps["action"], again, rtol=0, atol=0)
    gaussian = torch.distributions.Normal(steps["loc"], steps["scale"])
    expected = gaussian.log_prob(steps["latent"]).sum(-1)
    torch.testing.assert_close(steps["latent_log_prob"], expected)


def test_policy_has_the_distribution_of_the_actor(state: TensorDictBase) -> None:
    """Base density less log-determinant is the actor's own density, by inversion, of the action."""
    actor = make_actor(Gaussian(0.2, 0.5).double())
    state = many(state.apply(lambda t: t.double() if t.is_floating_point() else t), 16)
    with torch.no_grad():
        steps = split_at_latent(actor).policy(state)
        _, log_det = flow_head(actor).get_bijector(steps).forward_and_log_det(steps["latent"])
        expected = actor.get_dist(steps).log_prob(steps["action"])
    assert steps["action"].dtype == torch.float64
    torch.testing.assert_close(steps["latent_log_prob"] - log_det, expected, rtol=0, atol=1e-7)


def test_deterministic_actions_are_those_of_the_actor(state: TensorDictBase) -> None:
    actor = make_actor()
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        expected = actor(state.copy())["action"]
        steps = split_at_latent(actor).policy(state.copy())
    torch.testing.assert_close(steps["action"], expected, rtol=0, atol=0)
    torch.testing.assert_close(steps["latent"], steps["loc"], rtol=0, atol=0)


def test_keys_and_options_of_the_actor_are_kept(env: TransformedEnv, state: TensorDictBase) -> None:
    drawn = make_tanh_actor(num_samples=3, default_interaction_type=InteractionType.RANDOM)
    actor = constrain(drawn, env)
    policy, base = split_at_latent(actor, latent_key=("inner", "z"), log_prob_key="score")
    with torch.no_grad():
        steps = policy(state.copy())
    assert steps["inner", "z"].shape == steps["action"].shape == (3, *state.shape, 2)
    assert steps["score"].shape == (3, *state.shape)
    assert base.dist_sample_keys == [("inner", "z")]
    assert base.log_prob_keys == ["score"]

    default = InteractionType.DETERMINISTIC
    actor = constrain(make_tanh_actor(default_interaction_type=default), env)
    steps = split_at_latent(actor).policy(state.copy())
    torch.testing.assert_close(steps["latent"], steps["loc"])


def test_networks_are_shared_and_nothing_is_added() -> None:
    actor = make_actor()
    policy, base = split_at_latent(actor)
    own = {id(parameter) for parameter in actor.parameters()}
    assert {id(parameter) for parameter in policy.parameters()} == own
    assert {id(parameter) for parameter in base.parameters()} == own
    assert policy.state_dict().keys() == actor.state_dict().keys()
    flow = FlowMap(flow_head(actor))
    assert not list(flow.parameters())
    assert not flow.state_dict()


@EVERY_COPY
def test_both_parts_can_be_copied_and_sent(
    copied: Callable[[Any], Any], state: TensorDictBase
) -> None:
    policy, base = split_at_latent(make_actor())
    with torch.no_grad():
        steps = copied(policy)(state.copy())
    score = copied(base).get_dist(steps).log_prob(steps["latent"])
    torch.testing.assert_close(score, steps["latent_log_prob"])


# The loss


@pytest.mark.parametrize("loc", [0.0, 3.0, 12.0, 40.0])
def test_ppo_ratios_are_one_before_an_update(
    loc: float, state: TensorDictBase, critic: ValueOperator
) -> None:
    policy, base = split_at_latent(make_actor(Gaussian(loc, 0.7)))
    with torch.no_grad():
        steps = policy(many(state, 32))
    losses = ClipPPOLoss(base, critic)(with_advantages(steps))
    assert losses["ESS"].item() == pytest.approx(1, abs=1e-6)
    assert losses["kl_approx"].abs().item() < 1e-6
    assert losses["max_ratio"].item() == pytest.approx(1, abs=1e-5)


def test_the_action_itself_could_not_be_scored(
    state: TensorDictBase, critic: ValueOperator
) -> None:
    """Why latents are stored: the same loss on stored actions, which it inverts."""
    actor = make_actor(Gaussian(12.0, 0.7), return_log_prob=True)
    with torch.no_grad():
        steps = actor(many(state, 32))
    loss = ClipPPOLoss(actor, critic, entropy_bonus=False)
    with pytest.warns(LostDensityWarning):
        losses = loss(with_advantages(steps))
    assert not losses["ESS"].item() > 0.1


def test_ratios_of_latents_are_those_of_actions(state: TensorDictBase) -> None:
    """In float64 and far from saturation, where actions can be scored by inversion."""
    network = Gaussian(0.2, 0.5).double()
    actor = make_actor(network)
    state = many(state.apply(lambda t: t.double() if t.is_floating_point() else t), 16)
    policy, base = split_at_latent(actor)
    with torch.no_grad():
        steps = policy(state)
        old = actor.get_dist(steps).log_prob(steps["action"])
        network.loc += 0.3
        network.log_scale -= 0.1
        expected = actor.get_dist(steps).log_prob(steps["action"]) - old
        ratio = base.get_dist(steps).log_prob(steps["latent"]) - steps["latent_log_prob"]
    assert expected.abs().min() > 1e-6
    torch.testing.assert_close(ratio, expected, rtol=0, atol=1e-7)


def test_ppo_update_reaches_the_network_and_moves_the_ratio(
    state: TensorDictBase, critic: ValueOperator
) -> None:
    network = Gaussian(12.0, 0.7)
    policy, base = split_at_latent(make_actor(network))
    with torch.no_grad():
        steps = with_advantages(policy(many(state, 32)))
    loss = ClipPPOLoss(base, critic)
    optimizer = torch.optim.Adam(loss.parameters(), lr=0.02)
    losses = loss(steps)
    sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert bool(parameter.grad.isfinite().all()), name
    assert network.loc.grad.abs().min() > 0
    before = network.loc.detach().clone()
    optimizer.step()
    assert bool((network.loc != before).all())
    assert loss(steps)["ESS"] < 1


def test_divergence_is_that_of_the_gaussians(state: TensorDictBase, critic: ValueOperator) -> None:
    network = Gaussian(1.0, 0.7)
    policy, base = split_at_latent(make_actor(network))
    with torch.no_grad():
        steps = with_advantages(policy(state))
        network.loc += 0.7
        losses = KLPENPPOLoss(base, critic, entropy_bonus=False)(steps)
    # Both components move by one standard deviation: 1/2 each.
    assert losses["kl"].mean().item() == pytest.approx(1, abs=1e-4)


def test_the_flow_moves_with_the_loss(state: TensorDictBase, critic: ValueOperator) -> None:
    policy, base = split_at_latent(make_actor())
    with torch.no_grad():
        steps = with_advantages(policy(state))
    loss = ClipPPOLoss(base, critic).double()  # the network is shared: the policy's, too
    losses = loss(steps.apply(lambda t: t.double() if t.is_floating_point() else t))
    assert losses["entropy"].dtype == torch.float64
    assert losses["ESS"].item() == pytest.approx(1, abs=1e-6)


# The entropy bonus


def test_entropy_is_that_of_the_action(state: TensorDictBase) -> None:
    actor = make_actor(Gaussian(0.3, 0.8))
    base = split_at_latent(actor).base
    with torch.no_grad():
        estimate = base.get_dist(many(state, 4000)).entropy().reshape(4000, -1)
        expected = -actor.get_dist(state).rsample_and_log_prob((4000,))[1]
    error = (estimate.var(0) / 4000 + expected.var(0) / 4000).sqrt()
    assert bool(((estimate.mean(0) - expected.mean(0)).abs() < 5 * error).all())


def test_entropy_does_not_reward_a_scale_without_end(state: TensorDictBase) -> None:
    """The latent's own entropy grows with the scale for ever, the action's falls in the end."""
    entropies, gradients = [], []
    for scale in (0.5, 10.0):
        network = Gaussian(0.0, scale)
        base = split_at_latent(make_actor(network)).base
        entropy = base.get_dist(many(state, 500)).entropy().mean()
        (gradient,) = torch.autograd.grad(entropy, network.log_scale)
        entropies.append(entropy.item())
        gradients.append(gradient)
    assert entropies[1] < entropies[0]
    assert bool((gradients[1] < 0).all())


def test_ppo_takes_this_entropy(state: TensorDictBase, critic: ValueOperator) -> None:
    policy, base = split_at_latent(make_actor(Gaussian(0.0, 10.0)))
    with torch.no_grad():
        steps = with_advantages(policy(many(state, 200)))
    losses = ClipPPOLoss(base, critic, entropy_coeff=1.0)(steps)
    latent = torch.distributions.Normal(0, 10.0).entropy().item() * 2
    assert losses["entropy"].item() < 0 < latent
    assert losses["loss_entropy"].item() == pytest.approx(-losses["entropy"].item(), rel=1e-5)


def test_reference_entropy_can_be_asked_for(state: TensorDictBase) -> None:
    actor = make_actor(Gaussian(0.3, 0.8))
    steps = many(state, 2000)
    with torch.no_grad():
        means = []
        for view in (actor, with_reference_entropy(actor)):
            torch.manual_seed(0)
            means.append(split_at_latent(view).base.get_dist(steps).entropy().mean().item())
    # The retractions shrink: their log-determinants are negative.
    assert means[1] > means[0] + 0.1


# Deterministic policies


def test_noise_on_the_latent_stays_allowed_and_on_the_action_does_not(
    state: TensorDictBase,
) -> None:
    flow = FlowMap(flow_head(make_actor()))
    network = TensorDictModule(nn.Linear(5, 2), ["observation"], ["latent"])
    noise = AdditiveGaussianModule(Unbounded(2), 1.0, 1.0, action_key="latent")
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        steps = TensorDictSequential(network, noise, flow)(many(state, 200))
        spec = flow.head.spec
        noise = AdditiveGaussianModule(spec, 1.0, 1.0, action_key="action")
        broken = TensorDictSequential(network, flow, noise)(many(state, 200))
    for name, good in inside(steps).items():
        assert bool(good.all()), name
    assert not bool(inside(broken)["battery"].all())
    assert not bool(inside(broken)["obstacle"].all())


# Refusals


def test_an_actor_without_constraints_is_refused() -> None:
    with pytest.raises(TypeError, match="ConstrainedFlowModule"):
        split_at_latent(make_tanh_actor())


def test_a_missing_latent_is_named(state: TensorDictBase) -> None:
    with pytest.raises(MissingGeometryError, match=r"expected latent, .* before the map"):
        FlowMap(flow_head(make_actor()))(state.copy())


def test_missing_geometry_is_named(state: TensorDictBase) -> None:
    bare = state.select("observation").set("latent", torch.zeros(*state.shape, 2))
    with pytest.raises(MissingGeometryError, match="battery"):
        FlowMap(flow_head(make_actor()))(bare)


@pytest.mark.parametrize("size", [1, 3])
def test_a_latent_of_another_size_is_refused(size: int, state: TensorDictBase) -> None:
    message = re.escape(
        f"expected latents of 2 components, as the action has, given shape (8, {size})"
    )
    with pytest.raises(ValueError, match=message):
        FlowMap(flow_head(make_actor()))(state.copy().set("latent", torch.zeros(8, size)))
