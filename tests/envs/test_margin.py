"""Margins, and actuators that round: the action that is executed remains in the set as stated."""

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor

from cnfp_torchrl.envs import constrain_env
from cnfp_torchrl.geometry import (
    Ball,
    Box,
    ConstraintSet,
    Ellipsoid,
    GeometryError,
    HalfSpaces,
    PositivePart,
    TaskSpaceBall,
    VisibleRegion,
    WeightedL1Ball,
)
from cnfp_torchrl.modules import make_constrained_actor
from cnfp_torchrl.tasks.point_nav import PointNavEnv
from tests.walls import Told

DIM, STATES = 2, 8
Publish = Callable[[TensorDictBase], ConstraintSet]


def zeros(state: TensorDictBase) -> Tensor:
    return torch.zeros(*state.shape, DIM)


def ones(state: TensorDictBase) -> Tensor:
    return torch.ones(state.shape)


FAMILIES: dict[str, Publish] = {
    "box": lambda s: Box(zeros(s) - 0.28, zeros(s) + 0.502),
    "ball": lambda s: Ball(zeros(s) + 0.2, 0.47 * ones(s)),
    "ellipsoid": lambda s: Ellipsoid(
        zeros(s), torch.tensor([[0.6, 0.0], [0.1, 0.3]]).expand(*s.shape, 2, 2)
    ),
    "half-spaces": lambda s: HalfSpaces(
        torch.tensor([[1.0, 2.0], [-3.0, 1.0]]).expand(*s.shape, 2, 2),
        torch.tensor([0.4, 0.7]).expand(*s.shape, 2),
    ),
    "weighted": lambda s: WeightedL1Ball(zeros(s) + torch.tensor([1.0, 3.0]), 0.7 * ones(s)),
    "positive part": lambda s: PositivePart(zeros(s) + torch.tensor([1.0, -2.0]), 0.4 * ones(s)),
    "task space": lambda s: TaskSpaceBall(
        torch.tensor([[1.0, 0.5], [0.0, 2.0]]).expand(*s.shape, 2, 2), zeros(s), 0.6 * ones(s)
    ),
}


class Corners(torch.nn.Module):
    """A network that pushes to the boundary everywhere."""

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        mean = 4 * torch.randn(*observation.shape[:-1], DIM)
        return mean, torch.ones_like(mean)


def actions(publish: Publish, **options: object) -> tuple[TensorDictBase, Tensor]:
    env = constrain_env(PointNavEnv([STATES]), Told(publish, **options))
    actor = make_constrained_actor(Corners(), env)
    state = env.reset().expand(300, STATES).clone()
    assert state["constraints", "told", "active"].all()
    return state, actor(state)["action"]


def to_int(bits: int) -> Callable[[Tensor], Tensor]:
    def rounded(action: Tensor) -> Tensor:
        steps = 2**bits - 1
        return ((action.double() + 1) / 2 * steps).round() / steps * 2 - 1

    return rounded


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(
    ("resolution", "rounded"),
    [
        (torch.float16, lambda action: action.half().double()),
        (torch.bfloat16, lambda action: action.bfloat16().double()),
        (torch.int16, to_int(16)),
        (torch.int8, to_int(8)),
        (0.05, lambda action: (action.double() / 0.05).round() * 0.05),
    ],
    ids=["float16", "bfloat16", "int16", "int8", "step"],
)
def test_a_rounded_action_is_inside(
    family: str, resolution: torch.dtype | float, rounded: Callable[[Tensor], Tensor]
) -> None:
    publish = FAMILIES[family]
    state, plain = actions(publish)
    assert not publish(state).contains(rounded(plain)).all()  # else rounding would be no test
    state, action = actions(publish, resolution=resolution)
    assert publish(state).contains(rounded(action)).all()


@pytest.mark.parametrize("family", FAMILIES)
def test_a_margin_is_kept_in_every_direction(family: str) -> None:
    publish, margin = FAMILIES[family], 0.06
    state, action = actions(publish, margin=margin)
    for angle in torch.linspace(0, 6.28, 37):
        shift = margin * torch.stack([angle.cos(), angle.sin()])
        assert publish(state).contains(action.double() + 0.999 * shift).all()


def test_without_either_nothing_is_moved() -> None:
    env = constrain_env(PointNavEnv([STATES]), Told(FAMILIES["ball"]))
    assert (env.reset()["constraints", "told", "radius"] == 0.47).all()


def test_a_set_smaller_than_the_margin_is_refused_by_name() -> None:
    env = constrain_env(PointNavEnv([STATES]), Told(FAMILIES["ball"], margin=0.5))
    with pytest.raises(GeometryError, match=r"'told'.*radius") as caught:
        env.reset()
    assert "leaves nothing" in "".join(caught.value.__notes__)


def test_families_that_cannot_be_moved_are_refused() -> None:
    def visible(state: TensorDictBase) -> ConstraintSet:
        wall = torch.full((2,), 2.0)
        return VisibleRegion(zeros(state), VisibleRegion.walls(-wall, wall), ones(state))

    with pytest.raises(TypeError, match="'told': expected a family of sets that can be moved"):
        constrain_env(PointNavEnv([STATES]), Told(visible, margin=0.1))


@pytest.mark.parametrize(
    "options", [{"margin": -0.1}, {"margin": float("nan")}, {"resolution": 0.0}], ids=str
)
def test_bad_settings_are_refused(options: dict[str, float]) -> None:
    (name,) = options
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        Told(FAMILIES["ball"], **options)
