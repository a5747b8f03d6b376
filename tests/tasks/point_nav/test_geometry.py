"""The sets of point navigation: sound, forward-invariant, and honest where nothing helps."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor

from cnfp_torchrl.envs import constrain_env
from cnfp_torchrl.geometry import Ball, Box
from cnfp_torchrl.tasks.point_nav import (
    BatteryGeometry,
    Layout,
    ObstacleGeometry,
    PointNavEnv,
    ShortestPath,
    VisibleObstacleGeometry,
)
from cnfp_torchrl.tasks.point_nav.geometry import read_observation
from tests.layouts import MAZE, NONE, THREE

BOUNDS = Box(torch.tensor([-1.0, -1.0]), torch.tensor([1.0, 1.0]))
LAYOUTS = {
    "reference": Layout(),
    "none": NONE,
    "three": replace(THREE, stations=((-0.9, -0.9), (0.9, 0.9)), battery_start=(75, 100)),
    "maze": replace(MAZE, battery_start=(85, 100)),
}


def guaranteed(layout: Layout, state: TensorDictBase) -> Tensor:
    """Tell where the module's docstring promises that violations never happen."""
    position, battery = read_observation(state, "observation")
    way = ShortestPath(layout).to_station(position)
    length = torch.linalg.vector_norm(way.waypoint - position, dim=-1) + way.rest
    reach = 0.9 * (layout.zone_radius + layout.step_length * (battery - layout.battery_threshold))
    return way.found & (length <= reach)


def towards_the_waypoint(ball: Ball) -> Tensor:
    """Return moves towards the ball's center, of 0.95 of a step, but not beyond it.

    Longer where the ball only just reaches into a corner of the action bounds: to where it is as
    far from the bounds, 1 - t max|u_i|, as from the ball's boundary, r - (length - t).
    """
    center, radius = ball.center, ball.radius.unsqueeze(-1)
    length = torch.linalg.vector_norm(center, dim=-1, keepdim=True)
    far = length.clamp(min=0.95)
    balanced = (1 + length - radius) / (far + center.abs().amax(-1, keepdim=True))
    return center * torch.maximum(0.95 / far, balanced).clamp(max=1)


class Walker:
    """Steps with allowed actions: `share` of the way from an inner point to the boundary."""

    def __init__(self, layout: Layout, number: int) -> None:
        self.env = PointNavEnv((number,), layout=layout, max_steps=10**9, seed=0)
        self.obstacle, self.battery = ObstacleGeometry(layout), BatteryGeometry(layout)
        self.state = self.env.reset()
        self.counted = guaranteed(layout, self.state)
        self.violations = torch.zeros(2)
        self.least_slack = torch.full((), torch.inf)
        self.least_safe_slack = torch.full((), torch.inf)

    def step(self, direction: Tensor, share: Tensor | float) -> None:
        box, ball = (
            self.obstacle.constraint_set(self.state),
            self.battery.constraint_set(self.state),
        )
        safe = towards_the_waypoint(ball)
        # The point next to that move with some room in the box. Moving towards a convex set
        # that contains the waypoint does not move away from the waypoint.
        anchor = torch.minimum(torch.maximum(safe, box.low + 0.04), box.high - 0.04)
        self.least_safe_slack = torch.minimum(self.least_safe_slack, self._slack(box, ball, safe))
        self.least_slack = torch.minimum(self.least_slack, self._slack(box, ball, anchor))
        gauge = torch.stack(
            [
                constraint_set.eroded().gauge(direction, anchor)
                for constraint_set in (BOUNDS, box, ball)
            ]
        ).amax(0)
        action = anchor + direction * (share / gauge).unsqueeze(-1)
        action = torch.where(self.counted.unsqueeze(-1), action, 0.0)
        inside = BOUNDS.contains(action) & box.contains(action) & ball.contains(action)
        assert inside[self.counted].all()
        self.state = self.env.step(self.state.set("action", action))["next"]
        self.violations += self.state["cost"][self.counted].sum(0)

    def _slack(self, box: Box, ball: Ball, action: Tensor) -> Tensor:
        slack = torch.stack(
            [constraint_set.slack(action) for constraint_set in (BOUNDS, box, ball)]
        ).amin(0)
        return slack[self.counted].min()


@pytest.mark.parametrize(
    ("name", "agents", "steps"),
    [("reference", 1000, 75), ("none", 250, 40), ("three", 250, 100), ("maze", 250, 100)],
)
@pytest.mark.parametrize("style", ["uniform", "constant", "corner"])
def test_allowed_actions_never_violate(name: str, agents: int, steps: int, style: str) -> None:
    """Random ones, and hostile ones: always the same extreme, always into a corner of the bounds.

    On the reference layout from every start; 225,000 steps in all. The move towards the
    waypoint stays 0.04 inside, so that there is always an allowed action, and a neighborhood of it.
    """
    walker = Walker(LAYOUTS[name], agents)
    assert walker.counted.float().mean() > (0.99 if name == "reference" else 0.5)
    constant = torch.randn(agents, 2)
    for _ in range(steps):
        if style == "uniform":
            walker.step(torch.randn(agents, 2), torch.rand(agents).sqrt())
        elif style == "constant":
            walker.step(constant, 1.0)
        else:
            walker.step(2.0 * torch.randint(2, (agents, 2)) - 1, 1.0)
    assert walker.violations.tolist() == [0, 0]
    assert walker.least_slack >= 0.0399
    if name == "reference":
        assert walker.least_safe_slack >= 0.04


def test_every_start_of_the_reference_layout_is_covered() -> None:
    state = PointNavEnv((20_000,), seed=0).reset()
    assert guaranteed(Layout(), state).all()


@pytest.mark.parametrize("name", ["reference", "three"])
def test_the_last_moment_is_exact(name: str) -> None:
    """From the farthest state that is still guaranteed, at any charge, the way home is open."""
    layout = LAYOUTS[name]
    walker = Walker(layout, 800)
    position, _ = read_observation(walker.state, "observation")
    way = walker.battery.path.to_station(position)
    length = torch.linalg.vector_norm(way.waypoint - position, dim=-1) + way.rest
    needed = (length / 0.9 - layout.zone_radius) / layout.step_length + layout.battery_threshold
    walker.state = walker.env.reset(position=position, battery=needed.ceil().clamp(21, 100).long())
    walker.counted = guaranteed(layout, walker.state)
    assert walker.counted.float().mean() > 0.9
    for _ in range(50):
        walker.step(torch.randn(800, 2), 1.0)
    assert walker.violations.tolist() == [0, 0]
    assert walker.least_slack >= 0.0399


def test_a_full_battery_allows_everything_and_an_empty_one_leads_home() -> None:
    env = PointNavEnv((3,), seed=0)
    state = env.reset(position=[0.5, 0.1], battery=[100, 26, 25])
    ball = BatteryGeometry().constraint_set(state)
    corners = torch.tensor([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
    inside = Ball(ball.center.unsqueeze(1), ball.radius.unsqueeze(1)).contains(corners)
    assert inside.sum(-1).tolist() == [4, 2, 2]
    # 0.9 of the zone and 0.9 of a step for each percent above 21, in steps of 0.1.
    assert ball.radius.tolist() == pytest.approx([72.0, 5.4, 4.5])
    assert ball.center[0].tolist() == pytest.approx([4.5, -1.0], abs=1e-5)


def test_the_box_faces_the_nearest_station_and_keeps_a_margin() -> None:
    env = PointNavEnv((4,), seed=0)
    state = env.reset(position=[[0.35, 0.2], [0.2, 0.35], [0.99, 0.0], [0.6, 0.6]])
    box = ObstacleGeometry().constraint_set(state)
    step, margin = 0.1, 1e-4
    expected_low = [(0.3 + margin - 0.35) / step, -1, -1, -0.499, -1, -1, -1, -1]
    assert box.low.flatten().tolist() == pytest.approx(expected_low, abs=1e-5)
    expected_high = [1, 1, 1, 1, (1 - margin - 0.99) / step, 1, 1, 1]
    assert box.high.flatten().tolist() == pytest.approx(expected_high, abs=1e-5)


def test_an_agent_within_the_margin_is_pushed_back() -> None:
    env = PointNavEnv((2,), seed=0)
    state = env.reset(position=[[0.30005, 0.0], [1.0, 0.2]])
    box = ObstacleGeometry().constraint_set(state).validate("obstacle")
    assert 0 < box.low[0, 0] < 0.001
    assert -0.0011 < box.high[1, 0] < 0


@pytest.mark.parametrize("name", LAYOUTS)
def test_where_nothing_helps_the_sets_are_valid_and_out_of_reach(name: str) -> None:
    """In a rectangle, or with a charge that is lost: exactly where the env must count."""
    layout = LAYOUTS[name]
    env = PointNavEnv((3000,), layout=layout, seed=0)
    state = env.reset(position=torch.rand(3000, 2) * 2 - 1, battery=torch.randint(0, 30, (3000,)))
    box = ObstacleGeometry(layout).constraint_set(state).validate("obstacle")
    ball = BatteryGeometry(layout).constraint_set(state).validate("battery")
    box_reachable = ((box.low < 1) & (box.high > -1)).all(-1)
    nearest = ball.center.clamp(-1, 1)
    ball_reachable = torch.linalg.vector_norm(ball.center - nearest, dim=-1) < ball.radius

    position, battery = read_observation(state, "observation")
    rectangles = env.dynamics.rectangles
    point = position.unsqueeze(-2)
    touching = ((point >= rectangles[:, :2]) & (point <= rectangles[:, 2:])).all(-1).any(-1)
    assert torch.equal(box_reachable, ~touching)
    assert not ball_reachable[battery <= 20].any()
    unavoidable = env.step(state.set("action", torch.zeros(3000, 2)))["next", "cost"]
    assert torch.equal(unavoidable[:, 1].bool(), battery <= 20)


def test_the_way_out_of_a_rectangle_is_the_shortest() -> None:
    env = PointNavEnv((2,), seed=0)
    state = env.reset(position=[[0.25, 0.1], [0.1, -0.29]])
    box = ObstacleGeometry().constraint_set(state)
    assert box.low.tolist() == [[2.0, -1.0], [-1.0, -3.0]]
    assert box.high.tolist() == [[3.0, 1.0], [1.0, -2.0]]


def test_a_station_out_of_every_way_is_no_error() -> None:
    """A station walled in: no promise, but valid sets, and the straight direction."""
    walls = (
        (-0.5, -0.5, 0.5, -0.4),
        (-0.5, 0.4, 0.5, 0.5),
        (-0.5, -0.4, -0.4, 0.4),
        (0.4, -0.4, 0.5, 0.4),
    )
    layout = Layout(rectangles=walls, stations=((0.0, 0.0),))
    state = PointNavEnv((50,), layout=layout, seed=0).reset()
    position, _ = read_observation(state, "observation")
    way = ShortestPath(layout).to_station(position)
    enclosed = (position.abs() < 0.4).all(-1)
    assert torch.equal(way.found, enclosed)
    ObstacleGeometry(layout).constraint_set(state).validate("obstacle")
    ball = BatteryGeometry(layout).constraint_set(state).validate("battery")
    assert torch.allclose(ball.center[~enclosed], -position[~enclosed] / 0.1)


@pytest.mark.parametrize("kind", [BatteryGeometry, ObstacleGeometry])
def test_margin_and_resolution_move_the_set_inwards(
    kind: type[BatteryGeometry] | type[ObstacleGeometry],
) -> None:
    margin, step = 0.04, 0.02
    geometry = kind(margin=margin, resolution=step)
    state = constrain_env(PointNavEnv((500,), seed=0), geometry).reset()
    state.update(geometry(state.clone()))
    (bijector,) = geometry.bijectors
    stated, published = geometry.constraint_set(state), bijector.get_set(state)
    moved = stated.slack(torch.zeros(500, 2)) - published.slack(torch.zeros(500, 2))
    # Half of the diagonal of a square grid cell.
    assert torch.allclose(moved, torch.tensor(margin + step / 2**0.5), atol=1e-4)


def test_moves_in_sight_take_no_margin() -> None:
    with pytest.raises(TypeError, match=r"'obstacle'.*moved inwards"):
        constrain_env(PointNavEnv((2,)), VisibleObstacleGeometry(margin=0.04))
