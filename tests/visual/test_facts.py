"""Facts of point navigation, by hand."""

import pytest
import torch
from torchrl.envs import Compose, GymEnv, TransformedEnv

from cnfp_torchrl.tasks.point_nav import BatteryGeometry, Layout, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.visual.facts import facts_of


def facts(position: list[float], battery: int, layout: Layout | None = None) -> tuple[str, dict]:
    base = PointNavEnv([], layout=layout)
    geometries = (BatteryGeometry(layout, "charge"), ObstacleGeometry(layout, "walls"))
    env = TransformedEnv(base, Compose(*geometries))
    provider = facts_of(env)
    assert provider is not None
    goal = torch.tensor([0.9, 0.9])
    said = provider(env.reset(position=torch.tensor(position), battery=battery, goal=goal))
    return said.situation, said.by_constraint


@pytest.mark.parametrize(
    ("position", "battery", "expected"),
    [
        # 0.45 from the station at (0.95, 0), 0.35 to its zone: 4 steps of 0.1; 0.2 from the wall x
        # = 0.3, 0.5 from the wall at 1.
        ([0.5, 0.0], 43, ["23 steps are left above 20 %", "0.450 long, 4 steps to its zone"]),
        ([0.5, 0.0], 20, ["0 steps are left above 20 %"]),
        ([0.5, 0.0], 19, ["below the threshold of 20 %"]),
        ([0.9, 0.0], 100, ["80 steps are left", "0.050 long, in its zone"]),
        ([0.5, 0.0], 43, ["nearest rectangle is 0.200 (2.0 steps) away", "wall is 0.500 (5.0"]),
        # From the corner (0.3, 0.3) by Pythagoras: 0.3 and 0.4.
        ([0.6, 0.7], 43, ["nearest rectangle is 0.500 (5.0 steps)", "wall is 0.300 (3.0 steps)"]),
        ([0.1, 0.1], 43, ["touches a rectangle"]),
    ],
)
def test_distances_and_steps(position: list[float], battery: int, expected: list[str]) -> None:
    situation, said = facts(position, battery)
    assert f"At ({position[0]:.3f}, {position[1]:.3f}), battery {battery} %" in situation
    assert set(said) == {"charge", "walls"}
    for words in expected:
        assert words in " ".join(said.values())


def test_goal_is_told() -> None:
    assert "goal 0.500 away (5.0 steps)" in facts([0.5, 0.6], 50)[0]


def test_layout_without_rectangles() -> None:
    assert (
        "No rectangles; the nearest wall is"
        in facts([0.5, 0.0], 50, Layout(rectangles=()))[1]["walls"]
    )


def test_nothing_is_known_of_other_environments() -> None:
    assert facts_of(None) is None
    assert facts_of(GymEnv("Pendulum-v1")) is None
