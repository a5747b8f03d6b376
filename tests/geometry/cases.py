"""The table of sets over which the property tests run: every family, width and batch shape."""

from __future__ import annotations

from collections.abc import Callable
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
    VisibleOrBox,
    VisibleRegion,
    WeightedL1Ball,
)

DTYPES = (torch.float32, torch.float64)

Make = Callable[[tuple[int, ...], int], tuple[ConstraintSet, Tensor]]
"""From a batch shape and a dimension: sets some units wide, and a point well inside each."""


def _box(batch: tuple[int, ...], d: int) -> tuple[ConstraintSet, Tensor]:
    low, high = -torch.rand(*batch, d) - 0.1, torch.rand(*batch, d) + 0.1
    return Box(low, high), (low + high) / 2


def _half_box(batch: tuple[int, ...], d: int) -> tuple[ConstraintSet, Tensor]:
    low = torch.rand(*batch, d) - 1.1
    low[..., ::2] = -torch.inf
    high = torch.full((d,), 0.25)
    return Box(low, high), torch.full((*batch, d), 0.125)


def _ball(batch: tuple[int, ...], d: int) -> tuple[ConstraintSet, Tensor]:
    center = torch.randn(*batch, d)
    return Ball(center, 0.3 + torch.rand(batch)), center


def _huge_ball(batch: tuple[int, ...], d: int) -> tuple[ConstraintSet, Tensor]:
    center = 40 * torch.nn.functional.normalize(torch.randn(*batch, d), dim=-1)
    return Ball(center, torch.full(batch, 40.5)), torch.zeros(*batch, d)


def _ellipsoid(batch: tuple[int, ...], d: int) -> tuple[ConstraintSet, Tensor]:
    center = torch.randn(*batch, d)
    scale_tril = torch.randn(*batch, d, d).tril(-1) * 0.3 / d**0.5
    scale_tril = scale_tril + torch.diag_embed(0.2 + torch.rand(*batch, d))
    return Ellipsoid(center, scale_tril), center


def _thin_ellipsoid(batch: tuple[int, ...], d: int) -> tuple[ConstraintSet, Tensor]:
    ellipsoid, center = _ellipsoid(batch, d)
    assert isinstance(ellipsoid, Ellipsoid)
    squeeze = torch.logspace(0, -2, d).unsqueeze(-1)
    return Ellipsoid(center, ellipsoid.scale_tril * squeeze), center


def _half_space(batch: tuple[int, ...], d: int) -> tuple[ConstraintSet, Tensor]:
    return HalfSpaces(torch.randn(*batch, 1, d), torch.rand(*batch, 1) + 0.1), torch.zeros(
        *batch, d
    )


def _polytope(batch: tuple[int, ...], d: int) -> tuple[ConstraintSet, Tensor]:
    normals = torch.nn.functional.normalize(torch.randn(*batch, 3 * d + 2, d), dim=-1)
    offsets = torch.rand(*batch, 3 * d + 2) + 0.3
    offsets[..., 0] = torch.inf
    return HalfSpaces(normals * 3, offsets), torch.zeros(*batch, d)


def _half_spaces_with_zero_rows(batch: tuple[int, ...], d: int) -> tuple[ConstraintSet, Tensor]:
    normals = torch.randn(*batch, 3, d)
    normals[..., 1:, :] = 0
    offsets = torch.rand(*batch, 3) + 0.1
    offsets[..., 2] = 0
    return HalfSpaces(normals, offsets), torch.zeros(*batch, d)


def _l1_ball(batch: tuple[int, ...], d: int) -> tuple[ConstraintSet, Tensor]:
    weights = torch.randn(*batch, d)
    return WeightedL1Ball(weights, 0.5 + torch.rand(batch)), torch.zeros(*batch, d)


def _l1_ball_with_zeros(batch: tuple[int, ...], d: int) -> tuple[ConstraintSet, Tensor]:
    weights = torch.randn(*batch, d)
    weights[..., ::3] = 0
    return WeightedL1Ball(weights, torch.ones(())), torch.zeros(*batch, d)


def _positive_part(batch: tuple[int, ...], d: int) -> tuple[ConstraintSet, Tensor]:
    weights = torch.randn(*batch, d).sign() * (0.3 + torch.rand(*batch, d))
    weights[..., 1::4] = 0
    return PositivePart(weights, 0.2 + torch.rand(batch)), torch.zeros(*batch, d)


def _task_space_ball(batch: tuple[int, ...], d: int) -> tuple[ConstraintSet, Tensor]:
    """About as many rows as half of the components, so that there is a null space if d > 1."""
    jacobian = torch.randn(*batch, (d + 1) // 2, d) / d**0.5
    inside = torch.randn(*batch, d)
    offset = -(jacobian * inside.unsqueeze(-2)).sum(-1)
    return TaskSpaceBall(jacobian, offset, 0.3 + torch.rand(batch)), inside


def _ball_of_some_components(batch: tuple[int, ...], d: int) -> tuple[ConstraintSet, Tensor]:
    return TaskSpaceBall(
        torch.eye(d)[: d // 2], 0.1 * torch.ones(d // 2), 0.4 * torch.ones(batch)
    ), (torch.zeros(*batch, d))


def _visible(batch: tuple[int, ...], d: int) -> tuple[ConstraintSet, Tensor]:
    """One rectangle about a unit away from the position, and walls."""
    position = 0.3 * torch.randn(*batch, d).clamp(-2, 2)
    away = torch.nn.functional.normalize(torch.randn(*batch, d), dim=-1)
    middle = position + away * (0.4 + 0.4 * d**0.5)
    half = 0.15 + 0.2 * torch.rand(*batch, d)
    rectangle = torch.stack([middle - half, middle + half], -2).unsqueeze(-3)
    walls = VisibleRegion.walls(-2 * torch.ones(d), 2 * torch.ones(d)).expand(*batch, -1, -1, -1)
    rectangles = torch.cat([rectangle, walls], -3)
    return VisibleRegion(position, rectangles, 0.5 * torch.ones(())), torch.zeros(*batch, d)


def _visible_or_box(batch: tuple[int, ...], d: int) -> tuple[ConstraintSet, Tensor]:
    region, inside = _visible(batch, d)
    half = 0.3 + torch.rand(*batch, d)
    in_sight = torch.randint(2, batch).float()
    return VisibleOrBox(**region.fields(), low=-half, high=half, in_sight=in_sight), inside


FAMILIES: dict[str, tuple[Make, tuple[int, ...]]] = {
    "box": (_box, (1, 2, 6, 32)),
    "half-box": (_half_box, (2, 6)),
    "ball": (_ball, (1, 2, 6, 32)),
    "huge-ball": (_huge_ball, (2, 32)),
    "ellipsoid": (_ellipsoid, (1, 2, 6, 32)),
    "thin-ellipsoid": (_thin_ellipsoid, (6,)),
    "half-space": (_half_space, (1, 2, 32)),
    "polytope": (_polytope, (2, 6, 32)),
    "l1-ball": (_l1_ball, (1, 2, 6, 32)),
    "l1-ball-with-zeros": (_l1_ball_with_zeros, (2, 32)),
    "positive-part": (_positive_part, (1, 2, 6, 32)),
    "task-space-ball": (_task_space_ball, (1, 2, 6, 32)),
    "ball-of-components": (_ball_of_some_components, (2, 6)),
    "visible": (_visible, (1, 2, 3)),
    "sight-or-box": (_visible_or_box, (2,)),
    "zero-rows": (_half_spaces_with_zero_rows, (2, 6)),
}

SIZES = (1e-3, 1.0, 1e3)
BATCH_SHAPES = ((), (7,), (2, 1, 3))


@dataclass(frozen=True)
class Case:
    """A batch of sets of one family.

    Args:
        name: id of the test.
        sets: sets in float64, of numbers that float32 holds too.
        inside: points well inside the sets, ``(*batch, d)``.
        size: width of the sets in action units, roughly.
    """

    name: str
    sets: ConstraintSet
    inside: Tensor
    size: float

    @property
    def convex(self) -> bool:
        return not isinstance(self.sets, VisibleRegion | VisibleOrBox)

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
        case VisibleOrBox(position, rectangles, step, low, high, in_sight):
            step, low, high = step / size, low * size, high * size
            return VisibleOrBox(position, rectangles, step, low, high, in_sight)
    raise TypeError(type(sets))


def _cases() -> list[Case]:
    """Return every family in every dimension, in all sizes for d = 2 and in turn for others."""
    torch.manual_seed(0)
    cases: list[Case] = []
    for name, (make, dims) in FAMILIES.items():
        for d in dims:
            for size in SIZES if d == 2 else (SIZES[len(cases) % 3],):
                batch = BATCH_SHAPES[len(cases) % len(BATCH_SHAPES)]
                sets, inside = make(batch, d)
                sets = _scaled(sets, size).with_fields(lambda field, _: field.float().double())
                inside = (inside * size).float().double()
                cases.append(Case(f"{name}-d{d}-size{size:g}-{list(batch)}", sets, inside, size))
    return cases


CASES = _cases()
