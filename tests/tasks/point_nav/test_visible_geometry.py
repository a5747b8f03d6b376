"""Moves in sight: never unsafe, less timid than the box, leading away where there is no room."""

import pytest
import torch
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from cnfp_torchrl.envs import ConstraintAnchor, constraint_bijectors
from cnfp_torchrl.modules import ConstrainedFlowModule
from cnfp_torchrl.tasks.point_nav import (
    BatteryGeometry,
    Layout,
    ObstacleGeometry,
    PointNavEnv,
    VisibleObstacleGeometry,
)
from cnfp_torchrl.tasks.point_nav.dynamics import Collision
from cnfp_torchrl.tasks.point_nav.indicators import leaves_arena, segment_touches_rectangle

ANGLES = torch.arange(200.0)
LAYOUTS = {
    "reference": Layout(),
    "empty": Layout(rectangles=()),
    "three": Layout(
        rectangles=((-0.6, -0.6, -0.2, -0.3), (0.1, -0.5, 0.4, 0.5), (-0.7, 0.2, -0.4, 0.7))
    ),
}


def make_env(
    layout: Layout, agents: int, flow: str, collision: Collision = "pass"
) -> tuple[TransformedEnv, ConstrainedFlowModule]:
    env = TransformedEnv(
        PointNavEnv([agents], layout=layout, collision=collision, seed=0),
        Compose(BatteryGeometry(layout), VisibleObstacleGeometry(layout)),
    )
    bijectors = constraint_bijectors(env)
    env.append_transform(ConstraintAnchor(bijectors))
    return env, ConstrainedFlowModule(env.action_spec_unbatched, bijectors, flow=flow)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_specs(batch: tuple[int, ...]) -> None:
    env = TransformedEnv(PointNavEnv(batch, seed=0), VisibleObstacleGeometry())
    check_env_specs(env)


@pytest.mark.parametrize("flow", ["exact", "radial"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_no_violations(layout: str, flow: str) -> None:
    """By Gaussian latents, hostile ones, and those of agents that keep their direction."""
    torch.manual_seed(0)
    env, head = make_env(LAYOUTS[layout], 3 * len(ANGLES), flow)
    constant = 1e6 * torch.stack([ANGLES.cos(), ANGLES.sin()], -1)
    state = env.reset()
    total = torch.zeros(2)
    for _ in range(100):
        drawn = torch.randn_like(constant)
        latent = torch.cat([drawn, 1e6 * drawn, constant])
        state["action"] = head.get_bijector(state)(latent)
        transition, state = env.step_and_maybe_reset(state)
        total += transition["next", "cost"].sum(0)
    assert total[0] == 0
    if layout != "three":
        # With rectangles between agent and station only the box keeps the way open.
        assert total[1] == 0


@pytest.mark.parametrize("layout", LAYOUTS)
def test_sight_is_never_unsafe_and_holds_more_than_the_box(layout: str) -> None:
    chart = LAYOUTS[layout]
    env = PointNavEnv([2000], layout=chart, seed=1)
    state = env.reset()
    sight = VisibleObstacleGeometry(chart).constraint_set(state)
    box = ObstacleGeometry(chart).constraint_set(state)
    action = 2 * torch.rand(50, 2000, 2) - 1
    in_sight, in_box = sight.contains(action), box.contains(action)
    position = state["observation"][:, :2].expand(50, 2000, 2)
    target = position + chart.step_length * action
    rectangles = torch.tensor(chart.rectangles).reshape(-1, 4)
    hit = segment_touches_rectangle(position, target, rectangles)
    hit = hit | leaves_arena(target, torch.tensor(chart.wall))
    # Moves of rounded ends are those of the set moved inwards.
    assert not (sight.eroded().contains(action) & hit).any()
    assert (in_sight | ~in_box).all()
    if layout != "empty":
        assert in_sight.sum() > in_box.sum()
    # Nothing is given up but what rounding may do.
    assert (in_sight | hit).float().mean() > 1 - 1e-4


def pressed(chart: Layout) -> Tensor:
    """Return positions off every edge, wall and corner by up to the margin, and on the walls."""
    wall = torch.tensor(chart.wall)
    boxes = torch.cat(
        [
            torch.tensor(chart.rectangles).reshape(-1, 2, 2),
            wall * torch.tensor([[[-1, -1], [1, 1]]]),
        ]
    )
    side = torch.ones_like(boxes)
    side[:, 0] = -1
    side[-1] *= -1
    found = [wall * torch.tensor([[1, 0.9], [-1, 0.9], [0.9, 1], [0.9, -1], [1, 1], [-1, -1]])]
    for gap in (0.0, 1e-6, 5e-5, 3e-4):
        off = torch.where(side > 0, boxes + gap, boxes - gap)
        off = torch.where(off == boxes, torch.nextafter(boxes, boxes + side), off)
        for x, y in ((0, 0), (0, 1), (1, 0), (1, 1)):
            corner = torch.stack([off[:, x, 0], off[:, y, 1]], -1)
            middle = (boxes[:, 0] + boxes[:, 1]) / 2 + 0.01
            found += [corner, torch.stack([corner[:, 0], middle[:, 1]], -1)]
            found += [torch.stack([middle[:, 0], corner[:, 1]], -1)]
    return torch.cat(found)


@pytest.mark.parametrize("collision", ["pass", "block"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_no_violations_from_starts_pressed_against_something(
    layout: str, collision: Collision
) -> None:
    torch.manual_seed(0)
    ways = torch.tensor(
        [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 1.0], [-1.0, -1.0]]
    )
    starts = pressed(LAYOUTS[layout])
    position = starts.repeat(len(ways) + 1, 1)
    way = ways.repeat_interleave(len(starts), 0)
    env, head = make_env(LAYOUTS[layout], len(position), "exact", collision)
    state = env.reset(position=position, battery=100)
    assert (state["observation"][:, :2] == position).all()
    for _ in range(10):
        latent = 1e6 * torch.cat([way, torch.randn_like(starts)])
        state["action"] = head.get_bijector(state)(latent)
        assert state["constraints", "obstacle", "active"].all()
        transition, state = env.step_and_maybe_reset(state)
        assert not transition["next", "cost"].any()


def test_a_start_in_a_rectangle_has_no_moves_in_sight() -> None:
    env, head = make_env(Layout(), 2, "exact")
    state = env.reset(position=torch.tensor([[0.0, 0.0], [0.3, 0.1]]), battery=100)
    assert not state["constraints", "obstacle", "active"].any()
    assert head.get_bijector(state)(torch.zeros(2, 2)).isfinite().all()


def test_gauge_and_gradient_are_finite_where_0_is_not_allowed() -> None:
    env, _ = make_env(Layout(), 2, "exact")
    state = env.reset(position=torch.tensor([[0.5, 0.5], [0.3 + 1e-6, 0.0]]), battery=100)
    allowed = VisibleObstacleGeometry().constraint_set(state).eroded()
    still = torch.zeros(2, 2)
    assert allowed.contains(still).tolist() == [True, False]
    direction = torch.randn(100, 2, 2, requires_grad=True)
    gauge = allowed.gauge(direction, state["constraints", "anchor"])
    gradient: Tensor = torch.autograd.grad(gauge.sum(), direction)[0]
    assert gauge.isfinite().all()
    assert gradient.isfinite().all()
