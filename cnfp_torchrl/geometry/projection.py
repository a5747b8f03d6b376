"""Euclidean projection: the closest allowed action, for one set and for an intersection."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeAlias

import torch
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.geometry.balls import Ball
from cnfp_torchrl.geometry.box import Box
from cnfp_torchrl.geometry.constraint_set import ConstraintSet
from cnfp_torchrl.geometry.half_spaces import HalfSpaces
from cnfp_torchrl.geometry.region import Region
from cnfp_torchrl.geometry.superlevel import Cone, KinkedSum, Rows

Projector: TypeAlias = Callable[[Tensor], Tensor]
"""From points ``(*batch, d)`` to the closest ones of a set."""

NEWTON_STEPS = 8
"""Steps of Newton's method onto a cone: rounding error where axes differ by up to some 30 times."""


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


def onto_kinked_sum(total: KinkedSum, point: Tensor) -> Tensor:
    """Return the closest point of a bounded sum, see `onto_box_and_kinked_sum`."""
    everywhere = torch.full_like(point, torch.inf)
    return onto_box_and_kinked_sum(Box(-everywhere, everywhere, validate_args=False), total, point)


def onto_box_and_kinked_sum(box: Box, total: KinkedSum, point: Tensor) -> Tensor:
    r"""Return the closest point of the intersection of a box and a bounded sum of kinked terms.

    By the optimality conditions it is :math:`a(\lambda)` with the smallest :math:`\lambda \ge 0`
    for which the sum is within its bound, where :math:`a_i(\lambda) = p_i - \lambda g_i`, with the
    slope :math:`g_i` of its side, as long as that lies in the box and has not reached 0; there it
    stops. The sum falls with :math:`\lambda` and is linear between 2 d kinks. Takes O(d^2).
    """
    slope = torch.where(point > 0, total.upper, total.lower)
    clamped = point.clamp(box.low, box.high)
    with torch.no_grad():
        # Where each component begins to move, and where it ceases to: at 0, or at the box's bound
        # before it. Towards 0 means down for positive components, up for negative ones.
        sign, size, steep = point.sign(), point.abs(), slope.abs()
        far = torch.where(point > 0, box.high, -box.low)
        near = torch.where(point > 0, box.low, -box.high).clamp(min=0)
        moves = (steep > 0) & (size > near) & (far > near)
        safe = torch.where(moves, steep, 1.0)
        begins = torch.where(moves, (size - far).clamp(min=0) / safe, torch.inf)
        ceases = torch.where(moves, (size - near) / safe, torch.inf)
        kinks = torch.cat([torch.zeros_like(begins[..., :1]), begins, ceases], -1)
        kinks = kinks.masked_fill(kinks.isinf(), 0)
        still = torch.maximum(total.upper * clamped, total.lower * clamped)
        reached = (size.unsqueeze(-2) - kinks.unsqueeze(-1) * steep.unsqueeze(-2)).clamp(
            min=near.unsqueeze(-2)
        )
        reached = torch.minimum(reached, far.unsqueeze(-2)) * steep.unsqueeze(-2)
        terms = torch.where(moves.unsqueeze(-2), reached, still.unsqueeze(-2))
        exceeds = terms.sum(-1) > total.size.unsqueeze(-1)
        last = torch.where(exceeds, kinks, -1.0).amax(-1, keepdim=True)
        moving = moves & (begins <= last) & (last < ceases)
        binds = moving.any(-1, keepdim=True) & (last >= 0)
        ceased = moves & (last >= ceases)
        fixed = torch.where(ceased, near * steep, still).masked_fill(moving, 0)
        room = total.size.unsqueeze(-1) - fixed.sum(-1, keepdim=True)
    along = slope * moving
    square = torch.where(binds, along.square().sum(-1, keepdim=True), 1.0)
    multiplier = ((along * point).sum(-1, keepdim=True) - room) / square
    stopped = torch.where(ceased, sign * near, clamped)
    return torch.where(moving & binds, point - multiplier * slope, stopped)


def cone_projector(cone: Cone) -> Projector:
    r"""Return the projection onto the ellipsoid or cylinder :math:`\{a : |W a + y| \le h\}`.

    In the basis of :math:`W^T W`, with squared singular values :math:`s_i^2`, the closest point's
    :math:`W a + y` has components :math:`m_i / (1 + \lambda s_i^2)`, m those at the point. Its
    length falls with :math:`\lambda`; the root where it is h is found by Newton's method on the
    inverse of the length, from the left (Moré 1977), and has the derivative of the implicit
    function in the point. What the set itself depends on gets no gradient.
    """
    with torch.no_grad():
        matrix, vector = cone.matrix.detach(), cone.vector.detach()
        squares, basis = torch.linalg.eigh(matrix.mT @ matrix)
        squares = squares.clamp(min=0)
        floor = torch.finfo(squares.dtype).eps * squares.amax(-1, keepdim=True)
        counts = squares > floor
        singular = squares.where(counts, 0).sqrt()
        images = matrix @ basis
        shift = (images * vector.unsqueeze(-1)).sum(-2) / singular.where(counts, 1)
        shift = shift.where(counts, 0)
        beyond = (vector.square().sum(-1) - shift.square().sum(-1)).clamp(min=0)
        # A set thinner than rounding error is taken as thick as that, so that the root is finite.
        least = torch.finfo(squares.dtype).eps * cone.size
        radius = (cone.size.square() - beyond).clamp(min=least.square()).sqrt().unsqueeze(-1)
    return partial(_onto_cone, singular, basis, shift, radius)


def _onto_cone(
    singular: Tensor, basis: Tensor, shift: Tensor, radius: Tensor, point: Tensor
) -> Tensor:
    turned = (basis * point.unsqueeze(-1)).sum(-2)
    image = singular * turned + shift
    squares = singular.square()
    with torch.no_grad():
        size = vector_norm(image, dim=-1, keepdim=True)
        outside = size > radius
        tiny = torch.finfo(point.dtype).tiny ** 0.5
        multiplier = torch.zeros_like(radius + size)
        for _ in range(NEWTON_STEPS):
            shrunk = image / (1 + multiplier * squares)
            length = vector_norm(shrunk, dim=-1, keepdim=True)
            bend = (shrunk.square() * squares / (1 + multiplier * squares)).sum(-1, keepdim=True)
            step = (length / radius.clamp(min=tiny) - 1) * length.square() / bend.clamp(min=tiny)
            multiplier = multiplier + torch.where(outside, step, 0.0)
        shrunk = image / (1 + multiplier * squares)
        bend = (shrunk.square() * squares / (1 + multiplier * squares)).sum(-1, keepdim=True)
        weight = torch.where(outside, shrunk / (1 + multiplier * squares), 0.0)
    # 0 in value; by it the multiplier has the derivative of the implicit function.
    follows = (weight * (image - image.detach())).sum(-1, keepdim=True)
    multiplier = multiplier + follows / torch.where(outside, bend, 1.0)
    back = (turned - multiplier * singular * shift) / (1 + multiplier * squares)
    return torch.where(outside, (basis * back.unsqueeze(-2)).sum(-1), point)


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


PROJECTIONS: dict[type[ConstraintSet], Callable[..., Tensor]] = {
    Box: onto_box,
    Ball: onto_ball,
    HalfSpaces: onto_half_space,
}
"""Closed-form projections of a point, by family; others may be added."""


def projector(constraint_set: ConstraintSet) -> Projector:
    """Return the projection onto a set, with all that points share computed once.

    By the closed form of its family in `PROJECTIONS`, else by the set's `superlevel`, so that every
    family that describes itself has a projection.

    Args:
        constraint_set: A set; of a non-convex one, what `superlevel` describes of it.

    Raises:
        TypeError: for a family that has neither.
    """
    # A plain look-up, not functools.singledispatch, which torch.compile cannot trace.
    closed = PROJECTIONS.get(type(constraint_set))
    if closed is not None:
        return partial(closed, constraint_set)
    described = constraint_set.superlevel()
    if isinstance(described, KinkedSum):
        return partial(onto_kinked_sum, described)
    if isinstance(described, Cone):
        return cone_projector(described)
    raise TypeError(
        "expected a set with a projection, one of "
        f"{[family.__name__ for family in PROJECTIONS]} or one whose `superlevel` is a Cone or a "
        f"KinkedSum, given {type(constraint_set).__name__}; a non-convex one is projected onto by "
        "project_onto_intersection, and the exact flow (flow=exact) takes every family"
    )


def project(constraint_set: ConstraintSet, point: Tensor) -> Tensor:
    r"""Return the closest point of a set, :math:`\arg\min_{a \in C} |a - p|`.

    Args:
        constraint_set: The set of a family in `PROJECTIONS`, or with a `superlevel`.
        point: Points p, ``(*batch, d)``.

    Raises:
        TypeError: when the family has no projection.
    """
    return projector(constraint_set)(point)


def project_onto_intersection(region: Region, point: Tensor, rounds: int) -> Tensor:
    r"""Return the closest point of the intersection of a region's active sets, or nearly so.

    Boxes count as one set, because the intersection of boxes is a box; half-spaces count row by
    row. A box alone, or with one ball, weighted L1 ball or positive part, is exact, up to rounding.
    Other intersections take Dykstra's algorithm, in which each set in turn projects the point plus
    its own correction, :math:`x \leftarrow P_k(x + p_k)`, and keeps what the projection took away,
    :math:`p_k \leftarrow x + p_k - P_k(x + p_k)`. The error falls with the number of rounds, slowly
    where boundaries meet at a small angle. The result may lie outside by that error; a retraction
    towards the anchor moves it inside (`cnfp_torchrl.bijectors.Projection`).

    Of non-convex sets the closest one of the points of their convex parts is taken
    (`ConstraintSet.parts_near`).

    Source: Boyle and Dykstra 1986, "A method for finding projections onto the intersection of
    convex sets in Hilbert spaces".

    Args:
        region: The region of sets that have a `projector` or convex parts; its anchor is used for
            the latter alone.
        point: Points ``(*batch, d)``.
        rounds: The number of rounds of Dykstra's algorithm, >= 1.

    Raises:
        TypeError: for a set without projection.
    """
    if any(part.parts_near(point) is not None for part in region.sets):
        return _closest_of_parts(region, point, rounds)
    box, others = _split(region)
    if not others:
        return onto_box(box, point)
    # The box comes last, not first, so that the action bounds hold after too few rounds; with it
    # one set that has a closed form together with it.
    joint = next((i for i, (part, _) in enumerate(others) if _joins_box(part)), None)
    last = (partial(onto_box, box), None) if joint is None else _with_box(box, *others.pop(joint))
    if not others:
        return last[0](point)
    parts = [*((projector(part), active) for part, active in others), last]
    corrections = [torch.zeros_like(point)] * len(parts)
    for _ in range(rounds):
        for k, (onto, active) in enumerate(parts):
            moved = point + corrections[k]
            projected = onto(moved)
            point = projected if active is None else torch.where(active, projected, moved)
            corrections[k] = moved - point
    return point


def _closest_of_parts(region: Region, point: Tensor, rounds: int) -> Tensor:
    """Return the closest of the projections onto the convex parts of non-convex sets.

    All sets are eroded once more, so that what is found lies in the region, although a non-convex
    region may hide it from its anchor.
    """
    magnitude = region.bounds.magnitude()
    sets = [part.eroded(magnitude) for part in region.widened()]
    parts = {k: rows for k, s in enumerate(sets) if (rows := s.parts_near(point)) is not None}
    for axis, (stage, rows) in enumerate(parts.items(), 1):
        assert isinstance(rows, Rows)
        # An axis of parts for each set, so that all choices are combined.
        ones = (1,) * (len(parts) - axis)
        normals, offsets = (
            field.unflatten(0, (-1, *ones)) for field in (rows.normals, rows.offsets)
        )
        if (counts := region.counts(stage)) is not None:
            offsets = torch.where(counts.unsqueeze(-1), offsets, torch.inf)
        sets[stage] = HalfSpaces(normals, offsets, validate_args=False)
    unchanged = region.relaxation and tuple(torch.zeros_like(rho) for rho in region.relaxation)
    convex = Region(sets, None, region.active, unchanged, validate_args=False)
    shape = torch.broadcast_shapes(point.shape, convex.shape)
    found = project_onto_intersection(convex, point.expand(shape), rounds)
    found = settled(region, found.flatten(0, len(parts) - 1))
    nearest = vector_norm(found - point, dim=-1).argmin(0)
    return found.gather(0, nearest[None, ..., None].expand(1, *found.shape[1:])).squeeze(0)


def settled(region: Region, point: Tensor) -> Tensor:
    """Return points of a region: those that lie in it, and the others pulled towards its anchor.

    Unlike `Region.pulled_in` it leaves points that a non-convex region hides from its anchor.
    """
    inside = region.contains(point).unsqueeze(-1)
    return torch.where(inside, point, region.pulled_in(point))


def _joins_box(part: ConstraintSet) -> bool:
    """Tell whether there is a closed form for a set's intersection with a box."""
    return isinstance(part, Ball) or isinstance(part.superlevel(), KinkedSum)


def _with_box(
    box: Box, part: ConstraintSet, active: Tensor | None
) -> tuple[Projector, Tensor | None]:
    """Return the projection onto a box and a set, where that is active."""
    if isinstance(part, Ball):
        both: Projector = partial(onto_box_and_ball, box, part)
    else:
        total = part.superlevel()
        assert isinstance(total, KinkedSum)
        both = partial(onto_box_and_kinked_sum, box, total)
    return partial(_where_active, both, box, active), None


def _where_active(both: Projector, box: Box, active: Tensor | None, point: Tensor) -> Tensor:
    if active is None:
        return both(point)
    return torch.where(active, both(point), onto_box(box, point))


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
