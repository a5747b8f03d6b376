"""Target networks that follow in one operation, against TorchRL's SoftUpdate."""

import copy
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import nn
from torchrl.objectives import SACLoss, SoftUpdate

from cnfp_torchrl.objectives import ConstrainedSACLoss, FusedSoftUpdate, SACLagrangianLoss
from cnfp_torchrl.training.networks import action_cost_network
from tests.point_nav import SPEC, make_actor, make_critic

TARGETS = ("target_qvalue_network_params", "target_cost_network_params")


@pytest.fixture(params=["torchrl", "constrained", "lagrangian"])
def loss(request: pytest.FixtureRequest) -> SACLoss:
    critic = make_critic()
    options = {"action_spec": SPEC}
    if request.param == "torchrl":
        return SACLoss(make_actor(), critic, **options)
    if request.param == "constrained":
        return ConstrainedSACLoss(make_actor(), critic, **options)
    cost = action_cost_network(5, 2, 2, hidden=[8])
    return SACLagrangianLoss(make_actor(), critic, cost, thresholds=[0.0, 0.0], **options)


def disturb(loss: SACLoss, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in loss.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=generator).to(parameter))


@pytest.mark.parametrize("options", [{"tau": 0.25}, {"eps": 0.9}, {"tau": 0.005}])
def test_it_is_torchrl_s(loss: SACLoss, options: dict[str, float]) -> None:
    other = copy.deepcopy(loss)
    updaters = FusedSoftUpdate(loss, **options), SoftUpdate(other, **options)
    for trained, updater in zip((loss, other), updaters, strict=True):
        disturb(trained, 0)
        updater.step()
        disturb(trained, 1)
        updater.step()
    state, expected = loss.state_dict(), other.state_dict()
    followed = [key for key in state if key.startswith(TARGETS)]
    assert followed
    for key, value in state.items():
        torch.testing.assert_close(value, expected[key], msg=key)


@pytest.mark.parametrize(
    "change",
    [
        lambda loss: loss.double(),
        lambda loss: loss.load_state_dict({k: v + 1 for k, v in loss.state_dict().items()}),
        lambda loss: nn.ModuleList([loss]).to(torch.float64),
    ],
    ids=["double", "load_state_dict", "part of another module"],
)
def test_targets_follow_after_the_loss_was_moved_or_loaded(
    loss: SACLoss, change: Callable[[SACLoss], Any]
) -> None:
    updater = FusedSoftUpdate(loss, tau=0.5)
    change(loss)
    disturb(loss, 0)
    before = {key: value.clone() for key, value in loss.state_dict().items()}
    updater.step()
    state = loss.state_dict()
    for key in [key for key in state if key.startswith(TARGETS)]:
        middle = (before[key] + state[key.removeprefix("target_")]) / 2
        torch.testing.assert_close(state[key], middle, msg=key)


def test_the_loss_knows_its_updater(loss: SACLoss, recwarn: pytest.WarningsRecorder) -> None:
    FusedSoftUpdate(loss, tau=0.5)
    assert loss.target_qvalue_network_params is not None
    assert not [warning for warning in recwarn if "target" in str(warning.message)]


def test_both_or_neither_of_the_shares_are_refused(loss: SACLoss) -> None:
    with pytest.raises(ValueError, match="tau"):
        FusedSoftUpdate(loss, tau=0.1, eps=0.9)
