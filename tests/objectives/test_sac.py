"""Soft actor-critic on constrained actors: TorchRL's loss and ours."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.linalg import vector_norm
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SACLoss, SoftUpdate

from cnfp_torchrl.geometry import Box
from cnfp_torchrl.modules import flow_head, with_reference_entropy
from cnfp_torchrl.objectives import ConstrainedSACLoss, SACLagrangianLoss, usual_target_entropy
from cnfp_torchrl.training.networks import action_cost_network
from tests.point_nav import SPEC, make_actor, make_critic

# Most tests evaluate a loss once, without stepping its target networks.
pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

# The radial squash has no stage 0 of its own; its reference is the squash onto the bounds.
FLOWS = ["exact", "radial", "squash", "unconstrained"]

LOSSES: dict[str, Callable[..., SACLoss]] = {
    "torchrl": SACLoss,
    "torchrl, no vmap": lambda *networks, **options: SACLoss(
        *networks, deactivate_vmap=True, **options
    ),
    "reference": ConstrainedSACLoss,
    "reference, no vmap": lambda *networks, **options: ConstrainedSACLoss(
        *networks, deactivate_vmap=True, **options
    ),
    "action": lambda *networks, **options: ConstrainedSACLoss(
        *networks, entropy="action", **options
    ),
}
ALL_LOSSES = pytest.mark.parametrize("make_loss", LOSSES.values(), ids=LOSSES)


def total(losses: TensorDictBase) -> Tensor:
    return sum(value for name, value in losses.items() if name.startswith("loss_"))


def evaluated(loss: SACLoss, transitions: TensorDictBase) -> TensorDictBase:
    torch.manual_seed(1)
    return loss(transitions.clone())


# Losses run and teach -----------------------------------------------------------------------------


@ALL_LOSSES
@pytest.mark.parametrize("flow", FLOWS)
def test_gradients_reach_every_parameter(
    transitions: TensorDictBase, make_loss: Callable[..., SACLoss], flow: str
) -> None:
    actor = make_actor(flow=flow)
    loss = make_loss(actor, make_critic(), action_spec=SPEC)
    losses = loss(transitions)
    assert all(value.isfinite().all() for value in losses.values())
    total(losses).backward()
    for parameter in actor.parameters():
        assert parameter.grad.isfinite().all()
        assert parameter.grad.abs().sum() > 0
    for name, parameter in loss.named_parameters():
        if "target" not in name:
            assert parameter.grad.abs().sum() > 0, name


@ALL_LOSSES
def test_the_actor_itself_learns(
    transitions: TensorDictBase, make_loss: Callable[..., SACLoss]
) -> None:
    actor = make_actor()
    loss = make_loss(actor, make_critic(), action_spec=SPEC)
    mine = {parameter.data_ptr() for parameter in actor.parameters()}
    trained = {parameter.data_ptr() for parameter in loss.actor_network_params.parameters()}
    assert mine == trained
    optimizer = torch.optim.Adam(loss.parameters(), lr=0.1)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        before = actor(transitions.clone())["action"]
        total(loss(transitions)).backward()
        optimizer.step()
        after = actor(transitions.clone())["action"]
    assert not torch.allclose(before, after)


@ALL_LOSSES
def test_target_networks_follow(
    transitions: TensorDictBase, make_loss: Callable[..., SACLoss]
) -> None:
    loss = make_loss(make_actor(), make_critic(), action_spec=SPEC)
    target = SoftUpdate(loss, tau=0.25)
    before = loss.target_qvalue_network_params.data.clone()
    total(loss(transitions)).backward()
    torch.optim.Adam(loss.parameters(), lr=0.1).step()
    online = loss.qvalue_network_params.data.clone()
    target.step()
    expected = before * 0.75 + online * 0.25
    after = loss.target_qvalue_network_params.data
    assert not (after == before).all()
    for key, value in expected.items(True, True):
        torch.testing.assert_close(after[key], value)


@ALL_LOSSES
def test_the_target_entropy_is_minus_the_action_size(make_loss: Callable[..., SACLoss]) -> None:
    loss = make_loss(make_actor(), make_critic(), action_spec=SPEC)
    assert float(loss.target_entropy) == -2


@pytest.mark.parametrize("entropy", ["reference", "action"])
def test_vmap_changes_nothing(transitions: TensorDictBase, entropy: str) -> None:
    results = []
    actor = make_actor()
    for deactivated in (False, True):
        torch.manual_seed(0)  # of the second critic's weights
        loss = ConstrainedSACLoss(
            actor,
            make_critic(),
            entropy=entropy,
            action_spec=SPEC,
            deactivate_vmap=deactivated,
        )
        results.append(evaluated(loss, transitions))
    for name, value in results[0].items():
        torch.testing.assert_close(results[1][name], value, msg=name)


# Projected actions, which have no density --------------------------------------------------------


def test_projected_actions_learn_by_the_reference_entropy(transitions: TensorDictBase) -> None:
    actor = make_actor(flow="projection")
    losses = ConstrainedSACLoss(actor, make_critic(), action_spec=SPEC)(transitions)
    total(losses).backward()
    for parameter in actor.parameters():
        assert parameter.grad.isfinite().all()
        assert parameter.grad.abs().sum() > 0
    # The entropy rewarded is that of the tanh-squashed Gaussian, whatever is projected.
    state = actor(transitions.clone())
    projected = flow_head(with_reference_entropy(actor)).get_dist(state)
    unprojected = flow_head(make_actor(flow="unconstrained")).get_dist(state)
    torch.manual_seed(1)
    expected = unprojected.rsample_and_log_prob()[1]
    torch.manual_seed(1)
    torch.testing.assert_close(projected.rsample_and_log_prob()[1], expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("lagrangian", [False, True], ids=["sac", "lagrangian"])
def test_the_entropy_of_projected_actions_is_refused(lagrangian: bool) -> None:
    networks = [make_actor(flow="projection"), make_critic()]
    options: dict[str, Any] = {"entropy": "action", "action_spec": SPEC}
    make_loss: type[SACLoss] = ConstrainedSACLoss
    if lagrangian:
        make_loss = SACLagrangianLoss
        networks.append(action_cost_network(5, 2, 2, hidden=[8]))
        options["thresholds"] = [0.0, 0.0]
    with pytest.raises(ValueError, match=r"entropy: expected 'reference' .* given 'action'"):
        make_loss(*networks, **options)


# The two entropies --------------------------------------------------------------------------------


def share(actor: Any, transitions: TensorDictBase, latent: Tensor) -> Tensor:
    """s, by which the retractions shorten the way from the anchor, from the stages' positions."""
    stages = flow_head(actor).get_bijector(transitions).stages(latent).actions
    anchor = transitions["constraints", "anchor"]
    return vector_norm(stages[-1] - anchor, dim=-1) / vector_norm(stages[0] - anchor, dim=-1)


def test_the_reference_leaves_the_retractions_out(transitions: TensorDictBase) -> None:
    actor = make_actor(flow="gauge")  # whose share has the plain formula
    reference = with_reference_entropy(actor)
    drawn = []
    for policy in (actor, reference):
        torch.manual_seed(1)
        drawn.append(policy.get_dist(transitions.clone()).rsample_and_log_prob())
    (action, log_prob), (same_action, reference_log_prob) = drawn
    assert torch.equal(action, same_action)

    torch.manual_seed(1)
    latent = actor.get_dist(transitions.clone()).base_dist.rsample()
    s = share(actor, transitions, latent)
    assert (s < 0.9).any(), "nothing binds: this shows nothing"
    assert (s == 1).any()
    torch.testing.assert_close(reference_log_prob - log_prob, 2 * s.log(), rtol=1e-3, atol=1e-3)


def test_log_prob_is_the_true_density_with_either(transitions: TensorDictBase) -> None:
    actor = make_actor()
    densities = [
        policy.get_dist(transitions.clone()) for policy in (actor, with_reference_entropy(actor))
    ]
    action = densities[0].sample().clone()  # not the tensor that was drawn, scored by its latent
    assert torch.equal(densities[1].log_prob(action), densities[0].log_prob(action))


def test_the_loss_rewards_the_entropy_that_was_chosen(transitions: TensorDictBase) -> None:
    critic = make_critic()
    actor = make_actor(flow="gauge")
    losses = {
        entropy: ConstrainedSACLoss(actor, critic, entropy=entropy, action_spec=SPEC)
        for entropy in ("reference", "action")
    }
    entropies = {name: evaluated(loss, transitions)["entropy"] for name, loss in losses.items()}
    default = ConstrainedSACLoss(actor, critic, action_spec=SPEC)
    plain = SACLoss(actor, critic, action_spec=SPEC)
    assert torch.equal(evaluated(default, transitions)["entropy"], entropies["reference"])
    assert torch.equal(evaluated(plain, transitions)["entropy"], entropies["action"])

    torch.manual_seed(1)
    _ = torch.randn(256, 2)  # for the next actions, which the loss draws first
    latent = actor.get_dist(transitions.clone()).base_dist.rsample()
    expected = (2 * share(actor, transitions, latent).log()).mean()
    assert expected < -0.05
    torch.testing.assert_close(
        entropies["action"] - entropies["reference"], expected, rtol=1e-3, atol=1e-3
    )


@pytest.mark.parametrize("flow", ["squash", "unconstrained"])
def test_without_retractions_the_entropies_agree(transitions: TensorDictBase, flow: str) -> None:
    actor, entropies = make_actor(flow=flow), []
    for entropy in ("reference", "action"):
        loss = ConstrainedSACLoss(actor, make_critic(), entropy=entropy, action_spec=SPEC)
        entropies.append(evaluated(loss, transitions)["entropy"])
    assert torch.equal(*entropies)


# Settings -----------------------------------------------------------------------------------------


def test_the_discount_is_used(transitions: TensorDictBase) -> None:
    actor, results = make_actor(), {}
    for gamma in (0.0, 0.5, 0.99):
        torch.manual_seed(0)  # of the second critic's weights
        loss = ConstrainedSACLoss(actor, make_critic(), gamma=gamma, action_spec=SPEC)
        results[gamma] = float(evaluated(loss, transitions)["loss_qvalue"].detach())
    assert len(set(results.values())) == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"entropy": "none"}, "entropy: expected 'reference' or 'action', given 'none'"),
        ({"gamma": 1.0}, r"gamma: expected a discount in \[0, 1\), given 1.0"),
        ({"gamma": -0.1}, r"gamma: expected a discount in \[0, 1\), given -0.1"),
        ({"gamma": float("nan")}, r"gamma: expected a discount in \[0, 1\), given nan"),
    ],
)
def test_unknown_settings_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ConstrainedSACLoss(make_actor(), make_critic(), action_spec=SPEC, **options)


@pytest.mark.parametrize("entropy", ["reference", "action"])
def test_the_target_entropy_is_that_of_one_action_whatever_the_spec(
    env: TransformedEnv, entropy: str
) -> None:
    critic = make_critic()
    for spec in (env.action_spec, env.full_action_spec, SPEC, None):
        loss = ConstrainedSACLoss(make_actor(), critic, entropy=entropy, action_spec=spec)
        assert float(loss.target_entropy) == -2
    loss = ConstrainedSACLoss(make_actor(), critic, entropy=entropy, target_entropy=-4.0)
    assert float(loss.target_entropy) == -4


def test_the_usual_target_entropy_follows_the_units_of_the_action() -> None:
    def target(low: list[float], high: list[float]) -> float:
        return usual_target_entropy(Box(torch.tensor(low), torch.tensor(high)))

    assert target([-1.0] * 6, [1.0] * 6) == -6
    # As far below the entropy of the uniform distribution, log of the volume, in any units.
    below = math.log(2) + 1
    wide = target([-2.0, 0.0], [2.0, 1e-3])
    assert wide == pytest.approx(math.log(4) + math.log(1e-3) - 2 * below)
