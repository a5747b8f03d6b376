"""PPO and TD3 of constrained actors, which learn from latents."""

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.modules import ValueOperator
from torchrl.objectives import SoftUpdate

from cnfp_torchrl import make_constrained_actor
from cnfp_torchrl.modules import FlowMap, flow_head, split_at_latent
from cnfp_torchrl.objectives import ConstrainedPPOLoss, ConstrainedTD3Loss
from cnfp_torchrl.training.networks import (
    action_value_network,
    deterministic_network,
    gaussian_network,
    state_value_network,
)


def scaled(network: torch.nn.Module, by: float) -> torch.nn.Module:
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(by)
    return network


@pytest.mark.parametrize("entropy", ["reference", "action"])
def test_ratios_are_one_before_the_first_update_however_saturated(
    env: TransformedEnv, entropy: str
) -> None:
    actor = make_constrained_actor(scaled(gaussian_network(5, 2, hidden=[8]), 30.0), env)
    loss = ConstrainedPPOLoss(actor, state_value_network(5, 2, hidden=[8]), entropy=entropy)
    with torch.no_grad():
        steps = env.rollout(5, split_at_latent(actor).policy)
    assert (steps["latent"].abs() > 8).any()
    out = loss(loss.value_estimator(steps).reshape(-1))
    # The share of effective samples.
    torch.testing.assert_close(out["ESS"], torch.tensor(1.0), rtol=1e-4, atol=0.0)
    assert out["clip_fraction"] == 0
    assert out["loss_entropy"].isfinite()


def test_td3_asks_its_critic_about_allowed_actions_alone(
    env: TransformedEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    actor = make_constrained_actor(deterministic_network(5, 2, hidden=[8], noise=1.0), env)
    asked: list[tuple[TensorDictBase, Tensor]] = []
    loss = ConstrainedTD3Loss(actor, action_value_network(5, 2, hidden=[8]), policy_noise=2.0)
    SoftUpdate(loss, tau=0.1)  # TorchRL warns without one
    forward = FlowMap.forward

    def recorded(self: FlowMap, tensordict: TensorDictBase) -> TensorDictBase:
        mapped = forward(self, tensordict)
        if not torch._C._functorch.is_functorch_wrapped_tensor(mapped["action"]):
            asked.append((mapped.clone(), mapped["action"]))
        return mapped

    monkeypatch.setattr(FlowMap, "forward", recorded)
    steps = env.rollout(4, split_at_latent(actor).policy).reshape(-1)
    out = loss(steps)
    assert set(out.keys()) == {"loss_actor", "loss_qvalue"}
    head = flow_head(actor)
    assert len(asked) > 4
    for state, action in asked:
        assert head.get_region(state).contains(action).all()
    assert set(loss.critic_loss(steps).keys()) == {"loss_qvalue"}


def test_the_location_of_a_deterministic_network_stays_within_reach() -> None:
    network = scaled(deterministic_network(3, 2, hidden=[8], noise=0.3, reach=2.0), 50.0)
    loc, scale = network(torch.randn(100, 3))
    assert loc.abs().max() <= 2
    assert loc.abs().max() > 1.9
    assert (scale == 0.3).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"entropy": "maximal"}, "entropy: expected 'reference' or 'action'"),
        ({"gamma": 1.0}, "gamma: expected a discount"),
        ({"lmbda": 1.5}, "lmbda: expected a number in"),
    ],
)
def test_bad_arguments_are_refused(
    options: dict[str, object], message: str, env: TransformedEnv
) -> None:
    actor = make_constrained_actor(gaussian_network(5, 2, hidden=[8]), env)
    with pytest.raises(ValueError, match=message):
        ConstrainedPPOLoss(actor, state_value_network(5, 2, hidden=[8]), **options)
    if "gamma" in options:
        critic: ValueOperator = action_value_network(5, 2, hidden=[8])
        with pytest.raises(ValueError, match=message):
            ConstrainedTD3Loss(actor, critic, gamma=1.0)
