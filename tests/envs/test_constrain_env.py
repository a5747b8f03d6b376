import pytest
import torch
from torchrl.data import Binary, Bounded, OneHot, TensorSpec, Unbounded

from cnfp_torchrl import constrain_env, make_constrained_actor
from cnfp_torchrl.envs import constraint_bijectors
from cnfp_torchrl.keys import MissingGeometryError
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.training.networks import gaussian_network


@pytest.mark.parametrize(
    "spec",
    [
        Unbounded((3, 2)),
        OneHot(4, (3, 4)),
        Binary(2, (3, 2)),
        Bounded(-1.0, float("inf"), (3, 2)),
        Bounded(-1, 1, (3, 2), dtype=torch.int64),
        Bounded(-1.0, 1.0, (3,)),
    ],
    ids=lambda spec: type(spec).__name__,
)
def test_actions_without_bounds_are_refused_at_once(spec: TensorSpec) -> None:
    env = PointNavEnv([3])
    env.action_spec = spec
    with pytest.raises(ValueError, match=f"spec of 'action'.*given {type(spec).__name__}"):
        constrain_env(env, BatteryGeometry(), ObstacleGeometry())


@pytest.mark.parametrize("order", [["battery", "obstacle"], ["obstacle", "battery"]])
@pytest.mark.parametrize("with_anchor", [True, False])
def test_priority_is_the_stated_one_with_and_without_anchor(
    order: list[str], with_anchor: bool
) -> None:
    env = constrain_env(
        PointNavEnv([3]),
        BatteryGeometry(),
        ObstacleGeometry(),
        order=order,
        with_anchor=with_anchor,
    )
    assert [bijector.name for bijector in constraint_bijectors(env)] == order
    assert (("constraints", "anchor") in env.reset().keys(include_nested=True)) is with_anchor


def test_flows_that_guarantee_nothing_need_no_anchor() -> None:
    env = constrain_env(PointNavEnv([3]), BatteryGeometry(), ObstacleGeometry(), with_anchor=False)
    network = gaussian_network(5, 2, hidden=[4])
    assert env.rollout(2, make_constrained_actor(network, env, flow="squash")).shape == (3, 2)
    with pytest.raises(MissingGeometryError, match="anchor"):
        env.rollout(2, make_constrained_actor(network, env))


def test_an_order_that_nothing_could_state_is_refused() -> None:
    before = constrain_env(PointNavEnv([3]), BatteryGeometry(), with_anchor=False)
    with pytest.raises(ValueError, match="to come first where there is no anchor"):
        constrain_env(before, ObstacleGeometry(), order=["obstacle", "battery"], with_anchor=False)
