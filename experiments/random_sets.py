"""Random sets of every shipped family, of any batch shape and dimension."""

from __future__ import annotations

from collections.abc import Callable

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
    "zero-rows": (_half_spaces_with_zero_rows, (2, 6)),
}
"""By name: how they are made, and in which dimensions they are worth a look."""
