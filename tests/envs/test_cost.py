"""The cost transform: the environment's costs, one's own indicators, sums, names, bad input."""

from functools import partial

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import (
    EnvBase,
    GymEnv,
    ParallelEnv,
    RewardSum,
    SerialEnv,
    TransformedEnv,
    check_env_specs,
)

from cnfp_torchrl.envs import ConstraintCost, constraint_names, counted_constraints
from cnfp_torchrl.tasks.point_nav import PointNavEnv


def fast(tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> Tensor:
    return tensordict["action"].abs().amax(-1) > 0.5


def right(tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> Tensor:
    return next_tensordict["observation"][..., 0] > tensordict["observation"][..., 0]


@pytest.mark.parametrize("indicators", [None, {"fast": fast, "right": right}, {"right": right}])
@pytest.mark.parametrize("batch_size", [(), (4,), (2, 3)])
def test_costs_and_their_sum(batch_size: tuple[int, ...], indicators: dict | None) -> None:
    env = TransformedEnv(PointNavEnv(batch_size, max_steps=9, seed=0), ConstraintCost(indicators))
    check_env_specs(env)
    names = ("obstacle", "battery") if indicators is None else tuple(indicators)
    assert constraint_names(env) == names
    data = env.rollout(30, break_when_any_done=False)
    assert data["next", "cost"].dtype == torch.float32
    assert data["next", "cost"].shape == (*batch_size, 30, len(names))
    if indicators is not None:
        expected = torch.stack([f(data, data["next"]) for f in indicators.values()], -1)
        assert torch.equal(data["next", "cost"], expected.float())
        assert 0 < data["next", "cost"].mean() < 1
    time = len(batch_size)
    for episode in data.split(9, dim=time):
        total = episode["next", "cost"].cumsum(time)
        assert torch.equal(episode["next", "episode_cost"], total)


class Renamed(PointNavEnv):
    constraint_names = ("wall", "battery")


def test_names_through_a_stack() -> None:
    env = TransformedEnv(PointNavEnv(), ConstraintCost())
    assert env.transform.constraint_names == ("obstacle", "battery")
    assert constraint_names(PointNavEnv()) == ("obstacle", "battery")
    several = SerialEnv(2, PointNavEnv)
    several.reset()
    assert constraint_names(TransformedEnv(several, ConstraintCost())) == ("obstacle", "battery")
    several.close()
    others = SerialEnv(2, [PointNavEnv, Renamed])
    others.reset()
    with pytest.raises(ValueError, match="expected environments with the same constraint_names"):
        constraint_names(others)
    others.close()
    with pytest.raises(ValueError, match="expected one that names its constraints"):
        constraint_names(GymEnv("Pendulum-v1"))
    with pytest.raises(RuntimeError, match="expected indicators or an environment"):
        _ = ConstraintCost().constraint_names


def judged_in_a_worker() -> TransformedEnv:
    return TransformedEnv(GymEnv("Pendulum-v1"), ConstraintCost({"fast": fast}))


@pytest.mark.parametrize("batched", [SerialEnv, ParallelEnv])
@pytest.mark.parametrize(
    ("one", "names"),
    [(PointNavEnv, ("obstacle", "battery")), (judged_in_a_worker, ("fast",)), ("Pendulum-v1", ())],
)
def test_names_of_environments_in_a_row(batched: type, one: object, names: tuple[str, ...]) -> None:
    """Asked themselves, those not started recurse, and workers without an answer end."""
    make = partial(GymEnv, one) if isinstance(one, str) else one
    env = TransformedEnv(batched(2, make), RewardSum())
    assert counted_constraints(env) == names
    if not names:
        with pytest.raises(ValueError, match="expected one that names its constraints"):
            constraint_names(env)
    env.close(raise_if_closed=False)


def test_names_of_environments_in_a_row_that_have_begun() -> None:
    env = SerialEnv(2, PointNavEnv)
    env.reset()
    assert constraint_names(env) == ("obstacle", "battery")
    env.close()


def wide(tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> Tensor:
    return torch.zeros(4, 1, dtype=torch.bool)


def number(tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> Tensor:
    return torch.zeros(4)


def nothing(tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> None:
    return None


def test_an_indicator_returns_a_tensor() -> None:
    env = TransformedEnv(PointNavEnv((4,)), ConstraintCost({"odd": nothing}))  # type: ignore[dict-item]
    with pytest.raises(TypeError, match=r"'odd': expected it to return a bool tensor.*NoneType"):
        env.rollout(1)


@pytest.mark.parametrize(
    ("indicator", "given"), [(wide, r"torch.bool of shape \(4, 1\)"), (number, "torch.float32")]
)
def test_an_indicator_says_yes_or_no_for_each_agent(indicator: object, given: str) -> None:
    env = TransformedEnv(PointNavEnv((4,)), ConstraintCost({"odd": indicator}))  # type: ignore[dict-item]
    with pytest.raises(ValueError, match=rf"'odd': expected bool of shape \(4,\), given {given}"):
        env.rollout(1)


def test_without_costs_there_must_be_indicators() -> None:
    env: EnvBase = TransformedEnv(GymEnv("Pendulum-v1"), ConstraintCost())
    with pytest.raises(ValueError, match=r"expected an environment that publishes 'cost'"):
        _ = env.observation_spec
    with pytest.raises(ValueError, match="expected at least one, or None"):
        ConstraintCost({})


@pytest.mark.parametrize(
    ("indicators", "message"),
    [
        (fast, "indicators: expected a mapping .*given function; write ConstraintCost"),
        ([fast], "indicators: expected a mapping .*given list"),
        ({"fast": fast, "p": 3}, "indicator 'p': expected a function .*given 3"),
    ],
)
def test_indicators_are_named_functions(indicators: object, message: str) -> None:
    with pytest.raises(TypeError, match=message):
        ConstraintCost(indicators)  # type: ignore[arg-type]
