"""Flow policies in hand-made states."""

from collections.abc import Iterable, Mapping

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.geometry import (
    Ball,
    Box,
    ConstraintSet,
    HalfSpaces,
    PositivePart,
    Region,
    VisibleRegion,
    WeightedL1Ball,
)
from cnfp_torchrl.modules import ConstraintBijector, make_constrained_actor
from cnfp_torchrl.visual import FlowSnapshot, take_snapshot

t = torch.tensor

# Each binds somewhere in the action bounds [-1, 1]^d, and no two are the same.
PLANE: dict[str, ConstraintSet] = {
    "battery": Ball(t([0.6, 0.0]), t(0.9)),
    "obstacle": Box(t([-1.0, -1.0]), t([0.5, 0.4])),
    "speed": Ball(t([0.0, 0.0]), t(0.8)),
}
PLANE_OF_OTHERS: dict[str, ConstraintSet] = {
    "visible": VisibleRegion(t([0.0, 0.0]), t([[[0.2, -0.1], [0.4, 0.3]]]), t(1.0)),
    "power": PositivePart(t([1.0, 1.0]), t(1.1)),
    "diamond": WeightedL1Ball(t([1.0, 0.8]), t(0.9)),
}


class RigidBall(Ball):
    """A ball that cannot be widened, and is dropped where it cannot hold."""

    inflated = ConstraintSet.inflated


CONFLICT: dict[str, ConstraintSet] = {
    "far": RigidBall(t([1.3, 1.3]), t(0.5)),
    "near": Ball(t([-0.5, -0.5]), t(0.6)),
}
RELAXED: dict[str, ConstraintSet] = {
    "far": Ball(t([1.3, 1.3]), t(0.5)),
    "near": Ball(t([-0.5, -0.5]), t(0.6)),
}
LINE: dict[str, ConstraintSet] = {"box": Box(t([-0.7]), t([0.4])), "ball": Ball(t([0.4]), t(0.6))}
SPACE: dict[str, ConstraintSet] = {
    "ball": Ball(t([0.3, 0.0, 0.2]), t(0.8)),
    "half": HalfSpaces(t([[1.0, 1.0, 1.0]]), t([0.5])),
}


class Gaussian(nn.Module):
    """The same location and scale in every state."""

    def __init__(self, loc: Tensor, scale: Tensor) -> None:
        super().__init__()
        self.loc, self.scale = loc, scale

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        batch = observation.shape[:-1]
        return self.loc.expand(*batch, -1), self.scale.expand(*batch, -1)


def first(sets: Mapping[str, ConstraintSet], count: int) -> dict[str, ConstraintSet]:
    return dict(list(sets.items())[:count])


CASES: dict[str, tuple[dict[str, ConstraintSet], int]] = {
    "no constraint": ({}, 2),
    "one": (first(PLANE, 1), 2),
    "three": (PLANE, 2),
    "other families": (PLANE_OF_OTHERS, 2),
    "one is dropped": (CONFLICT, 2),
    "one is relaxed": (RELAXED, 2),
    "on a line": (LINE, 1),
    "in space": (SPACE, 3),
}
"""Constraints, and the dimension of the actions."""


def flows_in_cases(*flows: str, cases: Iterable[str] = CASES) -> pytest.MarkDecorator:
    """Parametrize by flow, constraints and dimension; some of the sets have no squash."""
    without_squash = ("other families", "in space", "one is dropped")
    return pytest.mark.parametrize(
        ("flow", "sets", "dim"),
        [
            pytest.param(flow, *CASES[name], id=f"{flow}-{name}")
            for name in cases
            for flow in flows
            if flow != "squash" or name not in without_squash
        ],
    )


def make_state(sets: Mapping[str, ConstraintSet], dim: int = 2) -> TensorDict:
    region = Region.build([Box(-torch.ones(dim), torch.ones(dim)), *sets.values()])
    assert region.active is not None
    assert region.relaxation is not None
    state = TensorDict({"observation": torch.zeros(3)}, [])
    state["constraints", "anchor"] = region.anchor
    for k, (name, constraint_set) in enumerate(sets.items(), start=1):
        state["constraints", name, "active"] = region.active[k]
        state["constraints", name, "relaxation"] = region.relaxation[k].amax(-1)
        if constraint_set.has_rows():
            state["constraints", name, "row_relaxation"] = region.relaxation[k]
        for field, value in constraint_set.fields().items():
            state["constraints", name, field] = value
    return state


def make_actor(
    sets: Mapping[str, ConstraintSet],
    flow: str = "exact",
    *,
    dim: int = 2,
    loc: Tensor | None = None,
    scale: Tensor | None = None,
) -> SafeProbabilisticTensorDictSequential:
    loc = torch.zeros(dim) if loc is None else loc
    scale = torch.ones(dim) if scale is None else scale
    return make_constrained_actor(
        Gaussian(loc, scale),
        spec=Bounded(-torch.ones(dim), torch.ones(dim)),
        bijectors=[
            ConstraintBijector(name, type(constraint_set)) for name, constraint_set in sets.items()
        ],
        flow=flow,
    )


def make_snapshot(
    sets: Mapping[str, ConstraintSet],
    flow: str = "exact",
    *,
    dim: int = 2,
    samples: int = 200,
    **gaussian: Tensor,
) -> FlowSnapshot:
    actor = make_actor(sets, flow, dim=dim, **gaussian)
    return take_snapshot(actor, make_state(sets, dim), samples=samples)
