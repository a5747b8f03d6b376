"""What point navigation shows of itself, by hand."""

import pytest
import torch
from torchrl.envs import Compose, TransformedEnv

from cnfp_torchrl.envs.task_view import Boxes, Map, find_task_view
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, Layout, ObstacleGeometry, PointNavEnv


def told(position: list[float], battery: int, layout: Layout | None = None) -> tuple[str, dict]:
    base = PointNavEnv([], layout=layout)
    geometries = (BatteryGeometry(layout, "charge"), ObstacleGeometry(layout, "walls"))
    env = TransformedEnv(base, Compose(*geometries))
    view = find_task_view(env)
    goal = torch.tensor([0.9, 0.9])
    state = env.reset(position=torch.tensor(position), battery=battery, goal=goal)
    return view.situation(state), view.constraint_sentences(state)


@pytest.mark.parametrize(
    ("position", "battery", "expected"),
    [
        # 0.45 from the station at (0.95, 0), 0.35 to its zone: 4 steps of 0.1; 0.2 from the wall x
        # = 0.3, 0.5 from the wall at 1.
        (
            [0.5, 0.0],
            43,
            ["23 steps are left above 20 %", "0.450 arena units long, 4 steps to its zone"],
        ),
        ([0.5, 0.0], 20, ["0 steps are left above 20 %"]),
        ([0.5, 0.0], 19, ["below the threshold of 20 %"]),
        ([0.9, 0.0], 100, ["80 steps are left", "0.050 arena units long, in its zone"]),
        (
            [0.5, 0.0],
            43,
            [
                "nearest rectangle is 0.200 arena units (2.0 steps) away",
                "wall is 0.500 arena units (5.0",
            ],
        ),
        # From the corner (0.3, 0.3) by Pythagoras: 0.3 and 0.4.
        (
            [0.6, 0.7],
            43,
            [
                "nearest rectangle is 0.500 arena units (5.0 steps)",
                "wall is 0.300 arena units (3.0 steps)",
            ],
        ),
        ([0.1, 0.1], 43, ["touches a rectangle"]),
    ],
)
def test_distances_and_steps(position: list[float], battery: int, expected: list[str]) -> None:
    situation, said = told(position, battery)
    assert (
        f"At ({position[0]:.3f}, {position[1]:.3f}) arena units, battery {battery} %" in situation
    )
    assert set(said) == {"charge", "walls"}
    for part in expected:
        assert part in " ".join(said.values())


def test_goal_is_told() -> None:
    assert "goal 0.500 arena units away (5.0 steps)" in told([0.5, 0.6], 50)[0]


def test_layout_without_rectangles() -> None:
    assert (
        "No rectangles; the nearest wall is"
        in told([0.5, 0.0], 50, Layout(rectangles=()))[1]["walls"]
    )


def test_the_map_is_the_layouts() -> None:
    layout = Layout(rectangles=((-0.6, -0.6, -0.2, -0.3), (0.1, -0.2, 0.5, 0.5)))
    view = find_task_view(PointNavEnv(layout=layout))
    assert isinstance(view.map, Map)
    (boxes,) = (shape for shape in view.map.shapes if isinstance(shape, Boxes))
    assert boxes.boxes == layout.rectangles
    assert view.map.step_length == layout.step_length


def test_positions_goals_and_charges_are_the_observations() -> None:
    env = PointNavEnv([3], seed=0)
    view, states = find_task_view(env), env.rollout(4)
    torch.testing.assert_close(view.position(states), states["observation"][..., :2])
    torch.testing.assert_close(view.goal(states), states["observation"][..., 3:])
    (series,) = view.series
    charge = view.series_values(states)[series.name]
    assert charge.shape == (3, 4)
    torch.testing.assert_close(charge[:, 0] - 1, charge[:, 1])
    assert series.limits == (0, 100)
    assert series.threshold == 20


def test_states_are_entered() -> None:
    env = PointNavEnv([3], seed=0)
    view, states = find_task_view(env), env.rollout(4)[:, 2]
    assert view.state_setter is not None
    env.reset()
    shown = view.state_setter(env, states)
    torch.testing.assert_close(shown["observation"], states["observation"])
