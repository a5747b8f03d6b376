"""The table of sets over which the property tests run: every family, width and batch shape."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cnfp_torchrl.geometry import (
    Ball,
    Box,
    ConstraintSet,
    Ellipsoid,
    HalfSpaces,
    PositivePart,
    TaskSpaceBall,
    VisibleRegion,
    WeightedL1Ball,
)
from experiments.random_sets import FAMILIES

DTYPES = (torch.float32, torch.float64)
BOUNDS = Box(-torch.ones(2).double(), torch.ones(2).double())
LEAST = 5e-5
"""The depth in these bounds, 2 wide, in float64."""


def t(*values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


SIZES = (1e-3, 1.0, 1e3)
BATCH_SHAPES = ((), (7,), (2, 1, 3))


@dataclass(frozen=True)
class Case:
    """A batch of sets of one family.

    Args:
        name: The id of the test.
        sets: Sets in float64, of numbers that float32 holds too.
        inside: Points well inside the sets, ``(*batch, d)``.
        size: The width of the sets in action units, roughly.
    """

    name: str
    sets: ConstraintSet
    inside: Tensor
    size: float

    @property
    def convex(self) -> bool:
        return not isinstance(self.sets, VisibleRegion)

    @property
    def bounds(self) -> Box:
        """Finite action bounds around the points inside, a few sizes wide."""
        reach = torch.tensor(3 * self.size) + self.inside.abs().amax()
        ones = torch.ones(self.sets.dim, dtype=self.inside.dtype)
        return Box(-reach.to(ones) * ones, reach.to(ones) * ones)

    def directions(self, count: int, dtype: torch.dtype) -> Tensor:
        """Return directions of length about `size`: Gaussian, along axes, diagonal, sparse."""
        d = self.sets.dim
        shape = (count, *self.inside.shape)
        gauss = torch.randn(shape, dtype=dtype)
        axis = torch.nn.functional.one_hot(torch.randint(d, shape[:-1]), d)
        sparse = gauss * (torch.rand(shape) < 0.2) + 1e-6 * gauss
        kinds = (gauss, axis * gauss.sign(), gauss.sign(), sparse)
        index = torch.arange(count)
        picked = torch.stack(kinds)[index % len(kinds), index]
        return picked.to(dtype) * self.size / picked.abs().amax(-1, keepdim=True).to(dtype)


def _scaled(sets: ConstraintSet, size: float) -> ConstraintSet:
    """Return sets whose points are those of the given ones times a size."""
    match sets:
        case Box(low, high):
            return Box(low * size, high * size)
        case Ball(center, radius):
            return Ball(center * size, radius * size)
        case Ellipsoid(center, scale_tril):
            return Ellipsoid(center * size, scale_tril * size)
        case HalfSpaces(normals, offsets):
            return HalfSpaces(normals, offsets * size)
        case WeightedL1Ball(weights, bound) | PositivePart(weights, bound):
            return type(sets)(weights / size, bound)
        case TaskSpaceBall(jacobian, offset, radius):
            return TaskSpaceBall(jacobian / size, offset, radius)
        case VisibleRegion(position, rectangles, step):
            return VisibleRegion(position, rectangles, step / size)
    raise TypeError(type(sets))


def _cases() -> list[Case]:
    """Return every family in every dimension, for d = 2 of two sizes, for others of all in turn."""
    torch.manual_seed(0)
    cases: list[Case] = []
    for name, (make, dims) in FAMILIES.items():
        for d in dims:
            for size in (SIZES[0], SIZES[-1]) if d == 2 else (SIZES[len(cases) % 3],):
                batch = BATCH_SHAPES[len(cases) % len(BATCH_SHAPES)]
                sets, inside = make(batch, d)
                sets = _scaled(sets, size).with_fields(lambda field, _: field.float().double())
                inside = (inside * size).float().double()
                cases.append(Case(f"{name}-d{d}-size{size:g}-{list(batch)}", sets, inside, size))
    return cases


CASES = _cases()
