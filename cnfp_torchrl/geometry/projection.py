"""Euclidean projection: the closest allowed action, for one set and for an intersection."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.geometry.balls import Ball
from cnfp_torchrl.geometry.box import Box
from cnfp_torchrl.geometry.constraint_set import ConstraintSet
from cnfp_torchrl.geometry.half_spaces import HalfSpaces
from cnfp_torchrl.geometry.region import Region


def onto_box(box: Box, point: Tensor) -> Tensor:
    r"""Return :math:`\min(\max(a, low), high)`, componentwise."""
    return point.clamp(box.low, box.high)


def onto_ball(ball: Ball, point: Tensor) -> Tensor:
    r"""Return :math:`m + (a - m)\, r / \max(|a - m|, r)`."""
    offset = point - ball.center
    # Not min(1, r / |a - m|), whose gradient is NaN at the center.
    reach = vector_norm(offset, dim=-1).clamp(min=ball.radius)
    return ball.center + offset * (ball.radius / reach).unsqueeze(-1)


def onto_half_space(half_space: HalfSpaces, point: Tensor) -> Tensor:
    r"""Return :math:`a - n \max(n \cdot a - b, 0) / |n|^2`, for a single row.

    Raises:
        TypeError: for several rows, whose intersection has no closed form.
    """
    if half_space.normals.shape[-2] != 1:
        raise TypeError(
            f"expected HalfSpaces of one row, given {half_space.normals.shape[-2]}; "
            "project_onto_intersection takes each row as a set of its own"
        )
    normal = half_space.normals.squeeze(-2)
    excess = ((normal * point).sum(-1, keepdim=True) - half_space.offsets).relu()
    # A normal of zero, which is never exceeded where the constraint can hold, divides by 1.
    square = normal.square().sum(-1, keepdim=True)
    return point - excess * normal / square.masked_fill(square == 0, 1)


PROJECTIONS: dict[type[ConstraintSet], Callable[..., Tensor]] = {
    Box: onto_box,
    Ball: onto_ball,
    HalfSpaces: onto_half_space,
}
"""Closed-form projections of a point, by family; others may be added."""


def project(constraint_set: ConstraintSet, point: Tensor) -> Tensor:
    r"""Return the closest point of a set, :math:`\arg\min_{a \in C} |a - p|`, in closed form.

    Args:
        constraint_set: set of a family in `PROJECTIONS`.
        point: points p, ``(*batch, d)``.

    Raises:
        TypeError: when the family has no closed-form projection.
    """
    # A plain look-up, not functools.singledispatch, which torch.compile cannot trace.
    projection = PROJECTIONS.get(type(constraint_set))
    if projection is None:
        raise TypeError(
            "expected a set with a closed-form projection, one of "
            f"{[family.__name__ for family in PROJECTIONS]}, given "
            f"{type(constraint_set).__name__}; use the exact flow (flow=exact), which takes every "
            "family"
        )
    return projection(constraint_set, point)


def onto_box_and_ball(box: Box, ball: Ball, point: Tensor) -> Tensor:
    r"""Return the closest point of the intersection of a box and a ball, which must not be empty.

    By the optimality conditions it is :math:`m + w(u)`, :math:`w(u) = P_{box - m}(u (a - m))`, with
    the largest u in [0, 1] for which :math:`|w(u)| \le r`. Each component of w is proportional to
    u until it stops at a bound, so :math:`|w(u)|^2` grows with u and has 2 d kinks. From the last
    kink inside the ball on, u has a closed form. Takes O(d^2).
    """
    offset = point - ball.center
    low, high, size = box.low - ball.center, box.high - ball.center, offset.abs()
    radius_squared = ball.radius.square()
    with torch.no_grad():
        # The u at which each component begins to move, and at which it ceases to.
        first = torch.where(offset >= 0, low, -high)
        last = torch.where(offset >= 0, high, -low)
        begins, ceases = (
            torch.where(size > 0, bound / size, 1.0).clamp(0, 1) for bound in (first, last)
        )
        kinks = torch.cat([begins, ceases], -1)
        at_kinks = (kinks.unsqueeze(-1) * size.unsqueeze(-2)).clamp(
            first.unsqueeze(-2), last.unsqueeze(-2)
        )
        inside = at_kinks.square().sum(-1) <= radius_squared.unsqueeze(-1)
        reached = torch.where(inside, kinks, 0.0).amax(-1, keepdim=True)
        moves = (begins <= reached) & (reached < ceases)
        stopped = (reached * size).clamp(first, last).masked_fill(moves, 0.0)
        room = radius_squared.unsqueeze(-1) - stopped.square().sum(-1, keepdim=True)
        binds = moves.any(-1, keepdim=True) & (room > 0)
    moving = (size.square() * moves).sum(-1, keepdim=True)
    share = (torch.where(binds, room, 1.0) / torch.where(binds, moving, 1.0)).sqrt().clamp(max=1)
    return ball.center + (share * offset).clamp(low, high)


def project_onto_intersection(region: Region, point: Tensor, rounds: int) -> Tensor:
    r"""Return the closest point of the intersection of a region's active sets, or nearly so.

    Boxes count as one set, because the intersection of boxes is a box; half-spaces count row by
    row. A box alone and a box with one ball are exact, up to rounding. Other intersections take
    Dykstra's algorithm, in which each set in turn projects the point plus its own correction,
    :math:`x \leftarrow P_k(x + p_k)`, and keeps what the projection took away,
    :math:`p_k \leftarrow x + p_k - P_k(x + p_k)`. The error falls with the number of rounds, slowly
    where boundaries meet at a small angle. The result may lie outside by that error; a retraction
    towards the anchor moves it inside (`cnfp_torchrl.bijectors.Projection`).

    Source: Boyle and Dykstra 1986, "A method for finding projections onto the intersection of
    convex sets in Hilbert spaces".

    Args:
        region: region of sets with closed-form projections; its anchor is not used.
        point: points ``(*batch, d)``.
        rounds: number of rounds of Dykstra's algorithm, >= 1.

    Raises:
        TypeError: for a set without closed-form projection.
    """
    box, others = _split(region)
    if not others:
        return onto_box(box, point)
    if len(others) == 1 and isinstance(ball := others[0][0], Ball):
        active = others[0][1]
        if active is None:
            return onto_box_and_ball(box, ball, point)
        return torch.where(active, onto_box_and_ball(box, ball, point), onto_box(box, point))
    # The box comes last, not first, so that the action bounds hold after too few rounds.
    parts = [*others, (box, None)]
    corrections = [torch.zeros_like(point)] * len(parts)
    for _ in range(rounds):
        for k, (part, active) in enumerate(parts):
            moved = point + corrections[k]
            projected = project(part, moved)
            point = projected if active is None else torch.where(active, projected, moved)
            corrections[k] = moved - point
    return point


def _split(region: Region) -> tuple[Box, list[tuple[ConstraintSet, Tensor | None]]]:
    """Return the intersection of all boxes, and the other sets with masks where they count."""
    low, high = region.bounds.low, region.bounds.high
    others: list[tuple[ConstraintSet, Tensor | None]] = []
    for stage, part in enumerate(region.widened()[1:], 1):
        counts = region.counts(stage)
        active = None if counts is None else counts.unsqueeze(-1)
        if isinstance(part, Box):
            lower, upper = part.low, part.high
            if active is not None:
                lower = torch.where(active, lower, -torch.inf)
                upper = torch.where(active, upper, torch.inf)
            low, high = torch.maximum(low, lower), torch.minimum(high, upper)
        elif isinstance(part, HalfSpaces):
            for row in range(part.normals.shape[-2]):
                normal, offset = part.normals[..., [row], :], part.offsets[..., [row]]
                others.append((HalfSpaces(normal, offset, validate_args=False), active))
        else:
            others.append((part, active))
    return Box(low, high, validate_args=False), others
