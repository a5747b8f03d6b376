"""The two states of the pictures: one where nothing binds, one where everything does."""

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import GymEnv, TransformedEnv

from cnfp_torchrl import constrain_env
from cnfp_torchrl.envs import GeometryTransform, constraint_bijectors, find_task_view
from cnfp_torchrl.geometry import Ball, Box, Region
from cnfp_torchrl.modules import ConstrainedFlowModule
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, Layout, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.visual import telling_states
from cnfp_torchrl.visual.states import openness

ORDER = ["battery", "obstacle"]
LAYOUTS = {
    "reference": Layout(),
    "several": Layout(
        rectangles=((-0.6, -0.6, -0.2, -0.3), (0.1, -0.2, 0.5, 0.5)), stations=((-0.9, 0.0),)
    ),
}


def head_of(env: TransformedEnv, order: list[str]) -> ConstrainedFlowModule:
    return ConstrainedFlowModule(
        env.action_spec_unbatched, constraint_bijectors(env), order=order, flow="exact"
    )


def point_nav(layout: Layout) -> TransformedEnv:
    geometry = {
        "battery": BatteryGeometry(layout, "battery"),
        "obstacle": ObstacleGeometry(layout, "obstacle"),
    }
    base = PointNavEnv([64], layout=layout, seed=0)
    return constrain_env(base, *geometry.values(), order=ORDER)


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_point_navigation(layout: Layout) -> None:
    env = point_nav(layout)
    head = head_of(env, ORDER)
    permissive, restrictive = telling_states(env, head)

    x, y, battery = permissive["observation"][:3].tolist()
    assert battery == 1
    for low_x, low_y, high_x, high_y in layout.rectangles:
        assert max(low_x - x, x - high_x, low_y - y, y - high_y) > layout.step_length
    share, _ = openness(head.get_region(permissive.unsqueeze(0)))
    assert share == 1

    x, y, battery = restrictive["observation"][:3].tolist()
    assert layout.battery_threshold / 100 < battery < 0.5
    beside = [
        max(low_x - x, x - high_x, low_y - y, y - high_y)
        for low_x, low_y, high_x, high_y in layout.rectangles
    ]
    assert 0 < min(beside) < layout.step_length
    region = head.get_region(restrictive)
    assert region.active is not None
    assert region.active.all()
    _, edge = openness(head.get_region(restrictive.unsqueeze(0)))
    assert (edge > 0).all()


@pytest.mark.parametrize(
    "layout",
    [Layout(rectangles=()), Layout(battery_threshold=80, battery_start=(90, 100))],
    ids=["no rectangles", "high threshold"],
)
def test_unusual_layouts(layout: Layout) -> None:
    env = point_nav(layout)
    permissive, restrictive = telling_states(env, head_of(env, ORDER))
    assert permissive["observation"][2] == 1
    assert layout.battery_threshold / 100 < restrictive["observation"][2] < 1


class SwingGently(GeometryTransform):
    """Less torque, the faster the pendulum turns."""

    def constraint_set(self, tensordict: TensorDictBase) -> Box:
        speed = tensordict["observation"][..., 2:]
        reach = 2 / (1 + speed.abs())
        return Box(-reach, reach, validate_args=False)


def test_environment_without_a_map() -> None:
    env = constrain_env(GymEnv("Pendulum-v1"), SwingGently("gentle"))
    env.set_seed(0)
    assert find_task_view(env).map is None
    permissive, restrictive = telling_states(env, head_of(env, ["gentle"]), steps=60)
    assert permissive.batch_size == restrictive.batch_size == torch.Size()
    assert restrictive["observation"][2].abs() > 2 * permissive["observation"][2].abs()


def test_openness_of_known_regions() -> None:
    bounds = Box(-torch.ones(2), torch.ones(2))
    half = Ball(torch.zeros(2), torch.tensor(0.5))
    huge = Ball(torch.zeros(2), torch.tensor(9.0))
    anchor = torch.zeros(1, 2)
    share, edge = openness(Region((bounds, huge, half), anchor))
    assert edge.tolist() == [[0.0, 1.0]]
    angles = torch.linspace(0, 2 * torch.pi, 10_001)[:-1]
    mean = (0.5 * torch.maximum(angles.cos().abs(), angles.sin().abs())).mean()
    assert share == pytest.approx(float(mean), abs=0.01)

    dropped = torch.tensor([[True, True, False]])
    share, edge = openness(Region((bounds, huge, half), anchor, dropped))
    assert share == 1
    assert edge.tolist() == [[0.0, 0.0]]


def test_openness_without_constraints() -> None:
    share, edge = openness(Region((Box(-torch.ones(3), torch.ones(3)),), torch.zeros(2, 3)))
    assert share.tolist() == [1, 1]
    assert edge.shape == (2, 0)
