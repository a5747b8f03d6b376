"""Moves in sight: never unsafe, less timid than the box, and a box where there is no room."""

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from cnfp_torchrl.envs import ConstraintAnchor, constraint_bijectors
from cnfp_torchrl.geometry import VisibleOrBox
from cnfp_torchrl.modules import ConstrainedFlowModule
from cnfp_torchrl.tasks.point_nav import (
    BatteryGeometry,
    Layout,
    ObstacleGeometry,
    PointNavEnv,
    VisibleObstacleGeometry,
)
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
    layout: Layout, agents: int, flow: str
) -> tuple[TransformedEnv, ConstrainedFlowModule]:
    env = TransformedEnv(
        PointNavEnv([agents], layout=layout, seed=0),
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
@pytest.mark.parametrize(
    "latents",
    [
        lambda: torch.randn(200, 2),
        lambda: torch.randn(200, 2) * 1e6,
        lambda: 1e6 * torch.stack([ANGLES.cos(), ANGLES.sin()], -1),
    ],
    ids=["gaussian", "hostile", "constant"],
)
def test_no_violations(layout: str, flow: str, latents: object) -> None:
    env, head = make_env(LAYOUTS[layout], 200, flow)
    state = env.reset()
    total = torch.zeros(2)
    for _ in range(100):
        state["action"] = head.get_bijector(state)(latents())  # type: ignore[operator]
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
    assert not (in_sight & hit).any()
    assert (in_sight | ~in_box).all()
    if layout != "empty":
        assert in_sight.sum() > in_box.sum()
    # Only moves that pass within the margin are given up.
    assert (in_sight | hit).float().mean() > 0.999


def observation(x: float, y: float) -> TensorDict:
    return TensorDict({"observation": torch.tensor([[x, y, 1.0, 0.0, 0.9]])}, [1])


@pytest.mark.parametrize(
    ("x", "y", "sees"),
    [
        (0.5, 0.5, True),
        (0.3 + 5e-5, 0.0, False),
        (0.3 + 1e-6, 0.0, False),
        (0.3 + 3e-4, 0.0, True),
        (1.0 - 5e-5, 0.5, False),
        (0.0, 0.0, False),
    ],
)
def test_the_box_takes_over_where_there_is_no_room(x: float, y: float, sees: bool) -> None:
    allowed = VisibleObstacleGeometry().constraint_set(observation(x, y)).validate("obstacle")
    assert isinstance(allowed, VisibleOrBox)
    assert bool(allowed.sees) is sees
    still = torch.zeros(1, 2)
    assert bool(allowed.contains(still)) is sees
    if not sees:
        box = ObstacleGeometry().constraint_set(observation(x, y))
        action = 2 * torch.rand(1000, 1, 2) - 1
        assert torch.equal(allowed.contains(action), box.contains(action))


def test_gauge_and_gradient_are_finite_beside_a_masked_set() -> None:
    observations = TensorDict.cat([observation(0.5, 0.5), observation(0.3 + 5e-5, 0.0)])
    allowed = VisibleObstacleGeometry().constraint_set(observations)
    anchor = torch.tensor([[0.0, 0.0], [0.5, 0.0]])
    direction = torch.randn(100, 2, 2, requires_grad=True)
    gauge = allowed.gauge(direction, anchor)
    gradient: Tensor = torch.autograd.grad(gauge.sum(), direction)[0]
    assert gauge.isfinite().all()
    assert gradient.isfinite().all()
