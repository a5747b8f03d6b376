"""The dynamics beside an independent re-implementation: one agent, plain Python, exact numbers.

The re-implementation is written from the task's table, computes positions in float32 as the table's
environment does, and decides every comparison in rational arithmetic.
"""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor

from cnfp_torchrl.tasks.point_nav import Layout, PointNavEnv
from cnfp_torchrl.tasks.point_nav.dynamics import Collision
from cnfp_torchrl.tasks.point_nav.indicators import segment_touches_rectangle
from tests.layouts import NONE, THREE

F32 = np.float32
DYADIC = Layout(
    rectangles=((-0.25, -0.25, 0.25, 0.25), (0.5, 0.5, 0.75, 0.625), (-0.75, 0.25, -0.5, 0.75)),
    stations=((0.5, 0.0), (-0.5, -0.5)),
    step_length=0.125,
    zone_radius=0.125,
    goal_radius=0.125,
)
LAYOUTS = {
    "reference": Layout(),
    "none": NONE,
    "three": replace(THREE, battery_start=(21, 30)),
    "dyadic": DYADIC,
}


def exact(value: float) -> Fraction:
    return Fraction(float(F32(value)))


def touches(start: list[F32], end: list[F32], rectangle: tuple[float, ...]) -> bool:
    """Clip the segment's parameter interval [0, 1] by the two closed slabs."""
    first, last = Fraction(0), Fraction(1)
    for axis in (0, 1):
        low, high = exact(rectangle[axis]), exact(rectangle[axis + 2])
        at, by = exact(start[axis]), exact(end[axis]) - exact(start[axis])
        if by == 0:
            if not low <= at <= high:
                return False
        else:
            ends = sorted([(low - at) / by, (high - at) / by])
            first, last = max(first, ends[0]), min(last, ends[1])
    return first <= last


def near(a: list[F32], b: tuple[float, ...], radius: float) -> bool:
    return sum((exact(p) - exact(q)) ** 2 for p, q in zip(a, b, strict=True)) <= exact(radius) ** 2


class Agent:
    """The table of the task, read line by line."""

    def __init__(self, layout: Layout, collision: str, observation: np.ndarray) -> None:
        self.layout, self.collision = layout, collision
        self.place = [F32(observation[0]), F32(observation[1])]
        self.charge = round(float(observation[2]) * 100)
        self.goal = (float(observation[3]), float(observation[4]))

    def step(self, action: np.ndarray) -> tuple[float, list[float], bool]:
        lay = self.layout
        wanted = [
            F32(p + F32(lay.step_length) * F32(min(max(a, F32(-1)), F32(1))))
            for p, a in zip(self.place, action, strict=True)
        ]
        hit = any(touches(self.place, wanted, rectangle) for rectangle in lay.rectangles)
        out = any(abs(exact(w)) > exact(lay.wall) for w in wanted)
        if not ((hit or out) and self.collision == "block"):
            self.place = [F32(min(max(w, F32(-lay.wall)), F32(lay.wall))) for w in wanted]
        self.charge = self.charge - 1 if self.charge > 0 else 0
        low = self.charge < lay.battery_threshold
        if any(near(self.place, station, lay.zone_radius) for station in lay.stations):
            self.charge = 100
        distance = float(
            np.hypot(*(float(p) - g for p, g in zip(self.place, self.goal, strict=True)))
        )
        arrived = near(self.place, self.goal, lay.goal_radius)
        reward = -distance + (lay.goal_bonus if arrived else 0.0)
        return reward, [float(hit or out), float(low)], arrived


def compare(env: PointNavEnv, state: TensorDictBase, action: Tensor) -> TensorDictBase:
    """Step the environment and one agent for each element; return the outcome."""
    before = state["observation"].numpy()
    after = env.step(state.clone().set("action", action))["next"]
    observation = after["observation"].numpy()
    for i in range(len(before)):
        agent = Agent(env.layout, env.dynamics.collision, before[i])
        reward, cost, arrived = agent.step(action[i].numpy())
        assert observation[i, :2].tolist() == [float(p) for p in agent.place]
        assert observation[i, 2] == F32(agent.charge / 100)
        assert after["cost"][i].tolist() == cost
        assert float(after["reward"][i]) == pytest.approx(reward, abs=1e-6)
        assert (tuple(observation[i, 3:].tolist()) != agent.goal) == arrived
    return after


@pytest.mark.parametrize("collision", ["pass", "block"])
@pytest.mark.parametrize("name", LAYOUTS)
def test_rollouts_agree_with_the_table(name: str, collision: str) -> None:
    env = PointNavEnv((12,), layout=LAYOUTS[name], collision=collision, seed=3)
    state = env.reset()
    drift = torch.randn(12, 2)
    seen = torch.zeros(2)
    for _ in range(60):
        state = compare(env, state, drift + torch.randn(12, 2))  # often outside [-1, 1]
        seen += state["cost"].sum(0)
    assert seen[0] > 0
    if name == "three":
        assert seen[1] > 0


@pytest.mark.parametrize("collision", ["pass", "block"])
def test_grazing_moves_agree_with_the_table(collision: str) -> None:
    """All numbers are multiples of 1/64, so that touching happens all the time, and exactly."""
    env = PointNavEnv((1500,), layout=DYADIC, collision=collision, seed=0)
    grid = torch.randint(-64, 65, (1500, 2)) / 64
    steps = torch.tensor([-2.0, -1.0, -0.75, -0.5, -0.125, 0.0, 0.125, 0.5, 1.0, 2.0])
    state = env.reset(
        position=grid,
        battery=torch.randint(0, 24, (1500,)),
        goal=torch.randint(-64, 65, (1500, 2)) / 64,
    )
    cost = compare(env, state, steps[torch.randint(10, (1500, 2))])["cost"]
    assert 0.1 < cost[:, 0].mean() < 0.9
    assert 0.1 < cost[:, 1].mean() < 0.9


UNIT = torch.tensor([[-0.3, -0.3, 0.3, 0.3]])


@pytest.mark.parametrize(
    ("start_point", "end_point", "touching"),
    [
        ((-0.4, 0.3), (-0.3, 0.3), True),  # ends at the corner
        ((-0.4, 0.3), (0.4, 0.3), True),  # slides along the upper edge
        ((-0.4, 0.30000004), (0.4, 0.30000004), False),  # one float32 number above it
        ((0.3, -0.5), (0.3, -0.31), False),  # on the edge's line, stops short
        ((0.3, -0.5), (0.3, -0.3), True),
        ((0.0, 0.0), (0.0, 0.0), True),  # no move, inside
        ((0.3, 0.3), (0.3, 0.3), True),  # no move, at the corner
        ((0.4, 0.0), (0.4, 0.0), False),  # no move, outside
        ((0.5, 0.0), (0.0, 0.5), True),  # cuts the corner off
        ((0.65, 0.0), (0.0, 0.65), False),  # passes the corner, boxes overlap
        ((-0.5, -0.1), (0.5, 0.1), True),  # through, both ends outside
        ((0.1, 0.1), (-0.1, 0.0), True),  # both ends inside
    ],
)
def test_segments_and_a_closed_rectangle(
    start_point: tuple[float, ...], end_point: tuple[float, ...], touching: bool
) -> None:
    for a, b in ((start_point, end_point), (end_point, start_point)):
        for flip in (
            torch.tensor([1.0, 1.0]),
            torch.tensor([-1.0, 1.0]),
            torch.tensor([1.0, -1.0]),
        ):
            one, two = torch.tensor(a) * flip, torch.tensor(b) * flip
            assert bool(segment_touches_rectangle(one, two, UNIT)) is touching
            assert bool(segment_touches_rectangle(one.flip(0), two.flip(0), UNIT)) is touching


def test_a_segment_through_a_dyadic_corner_touches_it() -> None:
    """Slopes of all kinds through the corner (1/4, 1/4), and shifted by one float32 number."""
    corner = torch.tensor([0.25, 0.25])
    along = torch.stack([torch.arange(1, 33) / 64, -torch.arange(32, 0, -1) / 64], dim=-1)
    square = torch.tensor([[-0.25, -0.25, 0.25, 0.25]])
    begin, end = corner - along / 4, corner + along / 4
    assert segment_touches_rectangle(begin, end, square).all()
    away = torch.tensor([2.0**-24, 2.0**-24])
    assert not segment_touches_rectangle(begin + 2 * away, end + 2 * away, square).any()


def test_the_order_of_the_battery_update() -> None:
    """Reaching a station with 20 % left after the step is in time, with 19 % it is counted."""
    env = PointNavEnv((2,), seed=0)
    state = env.reset(position=[0.8, 0.0], battery=[21, 20], goal=[0.0, 0.9])
    after = compare(env, state, torch.tensor([[1.0, 0.0], [1.0, 0.0]]))
    assert after["cost"].tolist() == [[0.0, 0.0], [0.0, 1.0]]
    assert after["observation"][:, 2].tolist() == [1.0, 1.0]


@pytest.mark.parametrize(("collision", "x"), [("pass", 1.0), ("block", 0.96875)])
def test_an_agent_at_a_wall_is_clipped_or_blocked(collision: Collision, x: float) -> None:
    env = PointNavEnv((1,), collision=collision, seed=0)
    state = env.reset(position=[0.96875, 0.5], battery=50, goal=[0.0, 0.9])
    after = compare(env, state, torch.tensor([[1.0, 0.0]]))
    assert float(after["observation"][0, 0]) == x
    assert after["cost"].tolist() == [[1.0, 0.0]]
