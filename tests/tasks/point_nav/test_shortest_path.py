"""Shortest paths: lengths, progress, and the learning-free policy that follows them."""

import pytest
import torch

from cnfp_torchrl.tasks.point_nav import Layout, PointNavEnv, ShortestPath, shortest_path
from cnfp_torchrl.tasks.point_nav.indicators import segment_touches_rectangle
from cnfp_torchrl.tasks.point_nav.shortest_path import visible
from tests.layouts import MAZE, NONE, THREE


def test_on_the_reference_layout_the_waypoint_is_the_nearest_station() -> None:
    position = PointNavEnv((5000,), seed=0).reset()["observation"][:, :2]
    path = ShortestPath()
    way = path.to_station(position)
    stations = torch.tensor(Layout().stations)
    distance = torch.linalg.vector_norm(position.unsqueeze(1) - stations, dim=-1)
    to_waypoint = torch.linalg.vector_norm(position - way.waypoint, dim=-1)
    assert torch.allclose(to_waypoint, distance.amin(-1))
    assert (way.rest == 0).all()
    assert way.found.all()


@pytest.mark.parametrize("layout", [Layout(), MAZE])
def test_the_way_to_a_station_is_free_and_every_move_along_it_gains(layout: Layout) -> None:
    path = ShortestPath(layout)
    position = PointNavEnv((300,), layout=layout, seed=0).reset()["observation"][:, :2]
    for _ in range(60):
        way = path.to_station(position)
        assert way.found.all()
        assert not segment_touches_rectangle(position, way.waypoint, path.rectangles).any()
        move = way.waypoint - position
        length = torch.linalg.vector_norm(move, dim=-1)
        position = position + move * (0.095 / length.clamp(min=0.095)).unsqueeze(-1)
        after = path.to_station(position)
        left = torch.linalg.vector_norm(position - after.waypoint, dim=-1) + after.rest
        # At least the cautious speed, or arrival at the station.
        assert ((left <= length + way.rest - 0.09) | (left < 1e-6)).all()
    assert (left < 1e-6).all()


@pytest.mark.parametrize("layout", [Layout(), NONE, MAZE])
def test_following_waypoints_reaches_goals_without_a_collision(layout: Layout) -> None:
    env = PointNavEnv((300,), layout=layout, seed=0, max_steps=10**9)
    path = ShortestPath(layout)
    state = env.reset()
    first = state["observation"][:, 3:].clone()
    arrived = torch.zeros(300, dtype=torch.bool)
    for _ in range(100):
        position, goal = state["observation"][:, :2], state["observation"][:, 3:]
        move = (path.to_goal(position, goal) - position) / layout.step_length
        move = move / torch.linalg.vector_norm(move, dim=-1, keepdim=True).clamp(min=1)
        state = env.step(state.set("action", move))["next"]
        assert (state["cost"][:, 0] == 0).all()
        arrived |= (state["observation"][:, 3:] != first).any(-1)
    assert arrived.all()


def test_the_way_to_a_goal_is_the_shortest() -> None:
    """Around one square: straight where it is in sight, else by the better corner."""
    path = ShortestPath(clearance=0.02)
    position = torch.tensor([[-0.5, 0.1], [-0.5, -0.1], [-0.5, 0.6], [0.0, 0.0]])
    goal = torch.tensor([[0.5, 0.1], [0.5, -0.1], [0.5, 0.6], [0.5, 0.0]])
    expected = torch.tensor([[-0.32, 0.32], [-0.32, -0.32], [0.5, 0.6], [0.5, 0.0]])
    assert torch.allclose(path.to_goal(position, goal), expected)


@pytest.mark.parametrize("layout", [Layout(), NONE, THREE, MAZE])
def test_nodes_that_are_never_the_best_are_not_missed(
    layout: Layout, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also on prolonged sides and in rectangles; the reference needs its four stations alone."""
    position = torch.rand(20_000, 2) * 2 - 1
    edges = torch.tensor([*layout.rectangles, (-1.0, -1.0, 1.0, 1.0)])
    position[:5000, 0] = edges[torch.randint(len(edges), (5000,)), 2 * torch.randint(2, (5000,))]
    position[2500:7500, 1] = edges[torch.randint(len(edges), (5000,)), 1]
    path = ShortestPath(layout)
    way = path.to_station(position)
    monkeypatch.setattr(shortest_path, "_are_needed", lambda nodes, *_: nodes[:, 0] == nodes[:, 0])
    whole = ShortestPath(layout)
    expected = whole.to_station(position)
    assert (len(path.node_x), len(whole.node_x)) == (4, 20) or layout != Layout()
    assert torch.equal(way.found, expected.found)
    assert torch.equal(way.waypoint, expected.waypoint)
    assert torch.equal(way.rest, expected.rest)


def test_any_batch_shape() -> None:
    path = ShortestPath(MAZE)
    position = torch.rand(2, 3, 2) * 2 - 1
    one, all_of_them = path.to_station(position[1, 2]), path.to_station(position)
    for name in ("waypoint", "rest", "found"):
        torch.testing.assert_close(getattr(all_of_them, name)[1, 2], getattr(one, name))
    for among, alone in zip(all_of_them[:-1], one[:-1], strict=True):
        torch.testing.assert_close(among[..., [5]], alone)
    goals = path.to_goal(position, position.flip(0))
    torch.testing.assert_close(goals[1, 2], path.to_goal(position[1, 2], position[0, 2]))


def test_visibility_is_what_the_indicator_sees() -> None:
    """Two independent ways to decide it, which may differ by rounding where a segment grazes."""
    rectangles = torch.tensor(MAZE.rectangles)
    start, end = torch.rand(20_000, 2) * 2 - 1, torch.rand(20_000, 2) * 2 - 1
    end[:2000, 0] = start[:2000, 0]
    end[2000:4000, 1] = start[2000:4000, 1]
    outwards = 1e-6 * torch.tensor([-1.0, -1.0, 1.0, 1.0])
    smaller, larger = (
        segment_touches_rectangle(start, end, rectangles + sign * outwards) for sign in (-1, 1)
    )
    clear = smaller == larger
    assert clear.float().mean() > 0.999
    assert torch.equal(visible(start, end, rectangles, 0.0)[clear], ~larger[clear])


def test_the_clearance_must_exceed_the_margin() -> None:
    with pytest.raises(ValueError, match=r"clearance: expected more than 0.0001, given 0.0"):
        ShortestPath(clearance=0.0)
