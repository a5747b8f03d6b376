"""Episodes are drawn where they went, with what they broke."""

import numpy as np
import pytest
import torch
from matplotlib.collections import LineCollection
from matplotlib.patches import Rectangle
from tensordict.nn import TensorDictModule

from cnfp_torchrl.envs import Map, TaskView, find_task_view
from cnfp_torchrl.tasks.point_nav import Layout, PointNavEnv
from cnfp_torchrl.visual import constraint_colors
from cnfp_torchrl.visual.figures import Episode, record_episodes, trajectories
from tests.pictures import draws

LAYOUTS = {
    "reference": Layout(),
    "none": Layout(rectangles=(), stations=((0.5, 0.5),)),
    "several": Layout(
        rectangles=((-0.6, -0.6, -0.2, -0.3), (0.1, -0.2, 0.5, 0.5)), stations=((-0.9, 0.0),)
    ),
    "large": Layout(wall=3.0, start_limit=2.9, step_length=0.5, zone_radius=0.3),
}
NAMES = ("obstacle", "battery")
VIEW = find_task_view(PointNavEnv())


def episode(**changed: np.ndarray) -> Episode:
    positions = np.array([[-0.9, 0.5], [-0.5, 0.5], [0.0, 0.5], [0.5, 0.5]], dtype=np.float32)
    goal, other = [0.0, 0.55], [0.8, -0.8]
    values = {
        "positions": positions,
        "levels": np.array([22.0, 21.0, 20.0, 19.0]),
        "goals": np.array([goal, goal, other, other], dtype=np.float32),
        "rewards": np.array([-1.0, 9.5, -2.0]),
        "costs": np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]),
    }
    return Episode(**{**values, **changed})


def test_goals_that_were_replaced_were_reached() -> None:
    np.testing.assert_array_equal(episode().goals_reached, np.float32([[0.0, 0.55]]))
    assert len(episode(goals=np.zeros((4, 2))).goals_reached) == 0


def test_line_follows_the_agent_and_shows_the_battery() -> None:
    axes = trajectories(VIEW, [episode()], NAMES).axes[0]
    (line,) = (
        collection for collection in axes.collections if isinstance(collection, LineCollection)
    )
    way = episode().positions
    for k, segment in enumerate(line.get_segments()):
        np.testing.assert_allclose(segment, way[k : k + 2])
    np.testing.assert_array_equal(line.get_array(), [22, 21, 20])
    assert axes.get_aspect() == 1


def test_violations_are_marked_where_the_step_ended() -> None:
    figure = trajectories(VIEW, [episode()], NAMES)
    axes, colors = figure.axes[0], constraint_colors(NAMES)
    at = {line.get_color(): line.get_xydata() for line in axes.lines if line.get_marker() in "x+"}
    np.testing.assert_allclose(at[colors["obstacle"]], [[0.0, 0.5], [0.5, 0.5]])
    np.testing.assert_allclose(at[colors["battery"]], [[0.5, 0.5]])
    assert axes.get_title() == "return 6.5 · 1 goal · 3 violations"
    legend = {text.get_text() for text in figure.legends[0].get_texts()}
    assert {"breaks obstacle", "breaks battery"} < legend


def test_clean_episode_says_nothing_of_violations() -> None:
    figure = trajectories(VIEW, [episode(costs=np.zeros((3, 2)))], NAMES)
    assert figure.axes[0].get_title() == "return 6.5 · 1 goal"
    assert not any("breaks" in text.get_text() for text in figure.legends[0].get_texts())


def test_goals_are_filled_once_reached() -> None:
    axes = trajectories(VIEW, [episode()], NAMES).axes[0]
    stars = [line for line in axes.lines if line.get_marker() == "*"]
    faces = {tuple(star.get_xydata()[0].round(3)): star.get_markerfacecolor() for star in stars}
    assert faces[(0.0, 0.55)] != "white"
    assert faces[(0.8, -0.8)] == "white"


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_any_layout(layout: Layout) -> None:
    env = PointNavEnv([4], layout=layout, max_steps=8, seed=0)
    policy = TensorDictModule(
        lambda observation: torch.ones_like(observation[..., :2]), ["observation"], ["action"]
    )
    episodes = record_episodes(env, policy)
    assert len(episodes) == 4
    for episode in episodes:
        assert episode.positions.shape == (9, 2)
        moves = np.diff(episode.positions, axis=0)
        assert (moves <= layout.step_length + 1e-6).all()
        assert (moves[0] > 0).all()
    figure = trajectories(find_task_view(env), episodes, NAMES)
    shown = {
        (*p.get_xy(), p.get_xy()[0] + p.get_width(), p.get_xy()[1] + p.get_height())
        for p in figure.axes[0].patches
        if isinstance(p, Rectangle) and p.get_fill()
    }
    expected = np.array(sorted(layout.rectangles)).reshape(-1, 4)
    np.testing.assert_allclose(np.array(sorted(shown)).reshape(-1, 4), expected)
    assert draws(figure)


class Plain(TaskView):
    map = Map((0.0, 4.0), (-1.0, 1.0))


def test_a_map_is_enough() -> None:
    bare = episode(levels=None, goals=None, costs=np.zeros((3, 0)))
    figure = trajectories(Plain(), [bare])
    assert figure.axes[0].get_title() == "return 6.5"
    assert len(figure.axes) == 1
    assert draws(figure)
