"""Adam in one operation, against PyTorch's."""

import copy
from collections.abc import Callable
from typing import Any, cast

import pytest
import torch
from torch import Tensor, nn
from torch.optim import Adam

from cnfp_torchrl.objectives import FusedAdam


def trained(
    kind: Callable[..., Adam],
    between: Callable[[Adam, nn.Module, int], Adam | None] = lambda *_: None,
    **options: Any,
) -> tuple[list[Tensor], dict[str, Any]]:
    """Return a network's parameters and the optimizer's state after some steps."""
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 1))
    first, second = network[0].parameters(), network[2].parameters()
    optimizer = kind([{"params": first}, {"params": second, "lr": 0.1}], **options)
    for count in range(6):
        optimizer.zero_grad()
        network(torch.randn(5, 3)).square().mean().backward()
        optimizer = between(optimizer, network, count) or optimizer
        optimizer.step()
    return list(network.parameters()), optimizer.state_dict()


def without_a_gradient(_: Adam, network: nn.Module, count: int) -> None:
    if count in (0, 3):
        next(network.parameters()).grad = None


def with_another_rate(optimizer: Adam, _: nn.Module, count: int) -> None:
    optimizer.param_groups[0]["lr"] = 1 / (1 + count)


def loaded(optimizer: Adam, _: nn.Module, count: int) -> None:
    if count == 3:
        optimizer.load_state_dict(copy.deepcopy(optimizer.state_dict()))


def with_more_parameters(optimizer: Adam, network: nn.Module, count: int) -> None:
    if count == 3:
        added = nn.Parameter(torch.ones(2))
        network.register_parameter("added", added)
        optimizer.add_param_group({"params": [added]})
    if count >= 3:
        network.added.grad = torch.ones(2)


def with_groups_of_another_make(optimizer: Adam, _: nn.Module, count: int) -> None:
    first, second = optimizer.param_groups
    if count == 3:
        optimizer.param_groups[0] = {**first, "lr": 0.02}
    elif count == 4:
        first["params"].append(second["params"].pop())


def with_a_hook(optimizer: Adam, network: nn.Module, count: int) -> None:
    def halve(*_: Any) -> None:
        for parameter in network.parameters():
            assert parameter.grad is not None
            parameter.grad /= 2

    if count == 2:
        optimizer.register_step_pre_hook(halve)


def with_other_settings(optimizer: Adam, _: nn.Module, count: int) -> None:
    optimizer.param_groups[0]["maximize"] = count in (2, 3)
    optimizer.param_groups[1]["decoupled_weight_decay"] = count > 3


def begun_anew(optimizer: Adam, _: nn.Module, count: int) -> None:
    if count == 3:
        optimizer.state.clear()


def with_a_parameter_replaced(optimizer: Adam, network: nn.Module, count: int) -> None:
    if count == 3:
        layer = cast(nn.Linear, next(network.children()))
        replaced = nn.Parameter(torch.full((4, 3), 0.5))
        replaced.grad = torch.ones(4, 3)
        del optimizer.state[layer.weight]
        layer.weight = optimizer.param_groups[0]["params"][0] = replaced


@pytest.mark.parametrize(
    "between",
    [
        lambda *_: None,
        without_a_gradient,
        with_another_rate,
        loaded,
        with_more_parameters,
        with_groups_of_another_make,
        with_a_hook,
        with_other_settings,
        begun_anew,
        with_a_parameter_replaced,
    ],
)
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"weight_decay": 0.1, "betas": (0.5, 0.9)},
        {"weight_decay": 0.1, "decoupled_weight_decay": True},
        {"amsgrad": True},
        {"fused": False},
    ],
)
def test_it_is_adam(between: Callable[..., Adam | None], options: dict[str, Any]) -> None:
    expected = trained(Adam, between, **{"fused": True, **options})
    mine = trained(FusedAdam, between, **options)
    torch.testing.assert_close(mine, expected, rtol=0, atol=0)


def test_a_scheduler_counts_its_steps() -> None:
    parameter = nn.Parameter(torch.ones(2))
    optimizer = FusedAdam([parameter], lr=1.0)
    schedule = torch.optim.lr_scheduler.StepLR(optimizer, 1, gamma=0.1)
    moves = []
    for _ in range(4):
        before = parameter.detach().clone()
        parameter.grad = torch.ones(2)
        optimizer.step()
        schedule.step()
        moves.append(float((before - parameter.detach()).max()))
    assert moves == pytest.approx([1, 0.1, 0.01, 0.001], rel=1e-3)


def test_gradients_are_forgotten_or_zero() -> None:
    parameter = nn.Parameter(torch.ones(2))
    optimizer = FusedAdam([parameter])
    parameter.grad = torch.ones(2)
    optimizer.zero_grad(set_to_none=False)
    assert parameter.grad.tolist() == [0, 0]
    optimizer.zero_grad()
    assert parameter.grad is None
