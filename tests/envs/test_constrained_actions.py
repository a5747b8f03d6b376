"""The transform with which any agent of TorchRL acts within the constraints."""

import copy
from collections.abc import Callable

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.data import Bounded
from torchrl.envs import EnvBase, SerialEnv, TransformedEnv, check_env_specs

from cnfp_torchrl import constrain_env, make_constrained_actor
from cnfp_torchrl.envs import ActionGuard, ConstrainedActions
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.training.networks import gaussian_network


def make_env(*batch_size: int, **options: bool | str) -> TransformedEnv:
    base = PointNavEnv(batch_size, max_steps=25, seed=0)
    env = constrain_env(base, BatteryGeometry(), ObstacleGeometry())
    # The guard stands between the flow and the environment, and sees what is executed.
    return env.append_transform(ActionGuard()).append_transform(ConstrainedActions(**options))


@pytest.mark.parametrize("flow", ["exact", "gauge", "radial"])
@pytest.mark.parametrize("unbounded", [False, True])
def test_random_actions_are_safe(flow: str, unbounded: bool) -> None:
    torch.manual_seed(0)
    env = make_env(16, flow=flow, unbounded=unbounded)
    steps = env.rollout(60, break_when_any_done=False)
    assert steps["next", "done"].any()
    assert steps["next", "cost"].sum() == 0
    executed, free = steps["next", "executed_action"], steps["action"]
    assert (executed != free).any()
    assert (executed.abs() <= 1).all()
    assert steps["executed_action"][:, 0].eq(0).all()


def test_specs() -> None:
    env = make_env(3)
    check_env_specs(env)
    assert isinstance(env.action_spec, Bounded)
    scaled = constrain_env(_Wide(PointNavEnv((3,))), BatteryGeometry())
    scaled.append_transform(ConstrainedActions())
    assert scaled.action_spec.space.low.eq(-1).all()
    assert scaled.action_spec.space.high.eq(1).all()


def _Wide(env: PointNavEnv) -> PointNavEnv:
    env.action_spec = Bounded(-3.0, 2.0, (3, 2))
    return env


@pytest.mark.parametrize("copied", [lambda env: env, copy.deepcopy])
def test_in_workers_and_copies(copied: Callable[[EnvBase], EnvBase]) -> None:
    env = SerialEnv(2, lambda: copied(make_env()))
    assert env.rollout(60, break_when_any_done=False)["next", "cost"].sum() == 0


def test_collectors_warm_up_at_random_within_the_constraints() -> None:
    env = make_env(8)
    network = gaussian_network(5, 2, hidden=[8])
    # An actor of anybody's; its random actions are TorchRL's own.
    collector = Collector(
        env,
        lambda td: td.set("action", network(td["observation"])[0]),
        frames_per_batch=80,
        total_frames=240,
        init_random_frames=160,
        auto_register_policy_transforms=False,
    )
    for batch in collector:
        assert batch["next", "cost"].sum() == 0


def test_refusals() -> None:
    with pytest.raises(ValueError, match=r"flow: expected one that guarantees"):
        ConstrainedActions("unconstrained")
    env = make_env(4)
    with pytest.raises(ValueError, match="given ConstrainedActions behind them"):
        make_constrained_actor(gaussian_network(5, 2, hidden=[8]), env)
    with pytest.raises(RuntimeError, match="append it with"):
        ConstrainedActions().transform_input_spec(env.input_spec)
    state = env.reset()
    action = torch.zeros(4, 2)
    action[1, 0] = torch.inf
    with pytest.raises(ValueError, match=r"action at index \[1, 0\]: expected a finite number"):
        env.step(state.set("action", action))
    with pytest.raises(ValueError, match="expected one that publishes at least one constraint"):
        TransformedEnv(PointNavEnv((4,)), ConstrainedActions()).reset()
