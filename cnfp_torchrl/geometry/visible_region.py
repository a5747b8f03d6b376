"""The visible region: moves of a point along a straight line that touch no rectangle."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import torch
from torch import Tensor

from cnfp_torchrl.geometry.constraint_set import EROSION_IN_EPS, Bounds, ConstraintSet
from cnfp_torchrl.geometry.superlevel import Rows


@dataclass(frozen=True, eq=False)
class VisibleRegion(ConstraintSet):
    r"""Actions whose move, from p straight to :math:`p + step\, a`, touches no closed rectangle.

    Star-shaped about 0, not convex: a rectangle R hides its shadow
    :math:`\{\tau a : \tau \ge 1,\ p + step\, a \in R\}`, which is convex. About another anchor c
    the gauge is that of the part seen from c, which ends where a ray first enters a shadow. That
    part lies in the true set and is star-shaped about c, so a flow into it is safe and its density
    exact. The gauge jumps where rays graze a corner: the density is exact almost everywhere, but a
    pathwise gradient leaves out the jumps.

    Args:
        position: Positions p, ``(*batch, d)``, in units of length. A position in a rectangle makes
            the set empty.
        rectangles: Lowest and highest corners of m rectangles, ``(*batch, m, 2, d)``, in units of
            length; infinite ones make walls, see `walls`.
        step: Lengths moved by an action of one, ``(*batch,)``, positive and finite.
    """

    position: Tensor
    rectangles: Tensor
    step: Tensor

    event_dims: ClassVar[Mapping[str, int]] = {"position": 1, "rectangles": 3, "step": 0}
    finite_fields: ClassVar[frozenset[str]] = frozenset({"position", "step"})

    @staticmethod
    def walls(low: Tensor, high: Tensor) -> Tensor:
        """Return 2d infinite rectangles, ``(*batch, 2d, 2, d)``, that enclose an arena.

        Args:
            low: The lowest corner of the arena, ``(*batch, d)``.
            high: The highest corner of the arena, ``(*batch, d)``.
        """
        on_axis = torch.eye(low.shape[-1], dtype=torch.bool, device=low.device)
        below = torch.where(on_axis, low.unsqueeze(-2), torch.inf)
        above = torch.where(on_axis, high.unsqueeze(-2), -torch.inf)
        infinite = torch.full_like(below, torch.inf)
        return torch.cat(
            [torch.stack([-infinite, below], -2), torch.stack([above, infinite], -2)], -3
        )

    def invalid_fields(self) -> Iterator[tuple[str, Tensor, str]]:
        low, high = self.rectangles.unbind(-2)
        nowhere = (low > high) | (low == torch.inf) | (high == -torch.inf)
        everywhere = (low.isinf() & high.isinf()).all(-1, keepdim=True).expand_as(low)
        yield (
            "rectangles",
            torch.stack([nowhere, nowhere], -2),
            "low <= high, not the same infinity",
        )
        yield "rectangles", torch.stack([everywhere, everywhere], -2), "a finite bound"
        yield "step", self.step <= 0, "a finite step > 0"

    def shape_problem(self) -> str | None:
        count, corners = self.rectangles.shape[-3:-1]
        if count > 0 and corners == 2:
            return None
        return f"expected 'rectangles' (*batch, m >= 1, 2, d), given {tuple(self.rectangles.shape)}"

    def contains(self, action: Tensor) -> Tensor:
        move = (self.step.double().unsqueeze(-1) * action.double()).unsqueeze(-2)
        seen = self.rectangles.double() - self.position.double()[..., None, None, :]
        low, high = seen.unbind(-2)
        # Shares of the move between which it is within the rectangle's bounds on each axis.
        still = move == 0
        move = torch.where(still, 1.0, move)
        enters = torch.minimum(low / move, high / move)
        leaves = torch.maximum(low / move, high / move)
        between = (low <= 0) & (high >= 0)
        enters = torch.where(still, torch.where(between, -torch.inf, torch.inf), enters)
        leaves = torch.where(still, torch.where(between, torch.inf, -torch.inf), leaves)
        first, last = enters.amax(-1).clamp(min=0), leaves.amin(-1).clamp(max=1)
        return (first > last).all(-1)

    def slack(self, action: Tensor) -> Tensor:
        r"""Return the distance to the nearest shadow in the largest component, signed.

        :math:`\min_{\tau \ge 1} \max_i \max(\tau l_i - a_i, a_i - \tau h_i)` for a rectangle
        [l, h] in action units: a maximum over pairs of lines in tau, one rising, one falling, of
        where they cross, and over rising lines at tau = 1. Minus infinity inside a rectangle.
        """
        slope, rising, pair = self._lines()
        action = action.unsqueeze(-2)
        start = torch.cat([-action, action], -1)
        at_one = torch.where(rising, slope + start, -torch.inf).amax(-1)
        j, k = slope.unsqueeze(-1), slope.unsqueeze(-2)
        crossing = (j * start.unsqueeze(-2) - k * start.unsqueeze(-1)) / torch.where(pair, j - k, 1)
        crossing = torch.where(pair, crossing, -torch.inf).amax((-2, -1))
        return torch.maximum(at_one, crossing).amin(-1)

    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        r"""Return one over the share t at which the ray c + t v first enters a shadow, or 0.

        In a shadow means :math:`\tau l \le c + t v \le \tau h` for a :math:`\tau \ge 1`.
        Eliminating :math:`\tau` (Fourier and Motzkin) leaves an interval of t, bounded by pairs of
        those rows.
        """
        low, high, v, c = torch.broadcast_tensors(
            *self._in_action_units(), direction.unsqueeze(-2), anchor.unsqueeze(-2)
        )
        one, zero = torch.ones_like(v[..., :1]), torch.zeros_like(v[..., :1])
        # Rows A tau + B t + C >= 0; an infinite bound asks for nothing, so it becomes tau >= 0.
        tau = torch.cat([-low, high], -1)
        finite = tau.isfinite()
        tau = torch.cat([torch.where(finite, tau, 1.0), one], -1)
        t = torch.cat([torch.where(finite, torch.cat([v, -v], -1), 0.0), zero], -1)
        constant = torch.cat([torch.where(finite, torch.cat([c, -c], -1), 0.0), -one], -1)
        j, k = tau.unsqueeze(-1), tau.unsqueeze(-2)
        pair = (j > 0) & (k <= 0)
        rise = j * t.unsqueeze(-2) - k * t.unsqueeze(-1)
        level = j * constant.unsqueeze(-2) - k * constant.unsqueeze(-1)
        # Pairs ask for rise t + level >= 0. Those that fail at t = 0 tell where the ray enters, if
        # they ever hold; any that fails there tells that it passes by.
        enters = pair & (level < 0)
        entry = rise.clamp(min=0) / torch.where(enters, -level, 1.0)
        entry = torch.where(enters, entry, torch.inf).amin((-2, -1))
        passes = pair & (level >= 0) & (rise + level * entry[..., None, None] < 0)
        return torch.where(passes.any(-1).any(-1), 0.0, entry).amax(-1)

    def bounding_box(self) -> Bounds:
        """Return the bounds that walls set, rectangles infinite in all but one direction."""
        low, high = self._in_action_units()
        free = torch.cat([low.isneginf(), high.isposinf()], -1)
        wall = free.sum(-1, keepdim=True) == 2 * self.dim - 1
        above = torch.where(wall & low.isfinite(), low, torch.inf).amin(-2)
        below = torch.where(wall & high.isfinite(), high, -torch.inf).amax(-2)
        return Bounds(below, above)

    def eroded(self, magnitude: Tensor | float = 1.0) -> SeenFromOutside:
        """Return the part that is well inside, see `SeenFromOutside`."""
        grown = self._grown(magnitude).unsqueeze(-1)
        low, high = self.rectangles.unbind(-2)
        outer_low, outer_high = low - grown, high + grown
        position = self.position.unsqueeze(-2)
        takes_in = ((outer_low <= position) & (position <= outer_high)).all(-1, keepdim=True)
        # Of each grown rectangle that takes in the position it is left through the side of the
        # rectangle itself that the position is farthest from.
        before = torch.cat([low - position, position - high], -1)
        nearest = takes_in & (before > 0) & (before == before.amax(-1, keepdim=True))
        left, right = nearest.chunk(2, -1)
        last = torch.where(left, outer_low, torch.inf).amin(-2)
        first = torch.where(right, outer_high, -torch.inf).amax(-2)
        seen_from = torch.where(left.any(-2), last, self.position)
        seen_from = torch.where(right.any(-2), first, seen_from)
        return SeenFromOutside(
            seen_from,
            torch.stack([outer_low, outer_high], -2),
            self.step,
            (seen_from - self.position) / self.step.unsqueeze(-1),
            validate_args=False,
        )

    def rounding(self, magnitude: Tensor | float = 1.0) -> Tensor:
        """Return how far `eroded` moves the boundary, infinite where nothing is left of the set."""
        moved = self._grown(magnitude).amax(-1) / self.step
        inner = self.eroded(magnitude)
        return torch.where(inner.slack(inner.moved) >= 0, moved, torch.inf).unsqueeze(-1)

    def _grown(self, magnitude: Tensor | float) -> Tensor:
        """Return the rounding error of each rectangle's corners, ``(*batch, m)``, in length."""
        eps = EROSION_IN_EPS * torch.finfo(self.dtype).eps
        reach = self.position.abs().amax(-1) + self.step * magnitude
        corners = torch.where(self.rectangles.isinf(), 0.0, self.rectangles).abs().amax((-2, -1))
        return eps * (reach.unsqueeze(-1) + corners)

    def around(self, center: Tensor, radius: Tensor) -> Self:
        # One wall, further from the center than the radius, and nothing but it.
        low = torch.full_like(self.rectangles[..., 0, :], -torch.inf)
        high = torch.full_like(low, torch.inf)
        wall = (center[..., :1].abs() + radius.unsqueeze(-1)).unsqueeze(-2)
        first = torch.arange(self.dim, device=low.device) == 0
        low = torch.where(first, wall, low)
        rectangles = torch.stack(torch.broadcast_tensors(low, high), -2)
        return type(self)(-center, rectangles, torch.ones_like(self.step), validate_args=False)

    def superlevel(self) -> Rows:
        """Describe a convex part: before each rectangle, the side that leaves the most room."""
        return self.part_near(torch.zeros_like(self.position))

    def part_near(self, point: Tensor) -> Rows:
        """Describe the convex part with the largest slack at a point ``(*batch, d)``.

        What a rectangle leaves is a union of half-spaces, the lines of `slack`: this side of it, or
        past a corner of it on the side away from its shadow. One is taken for each rectangle.
        """
        normals, offsets, valid = self._half_spaces()
        slack = offsets - (normals * point[..., None, None, :]).sum(-1)
        best = torch.where(valid, slack, -torch.inf).argmax(-1)
        return _chosen(normals, offsets, valid, best)

    def parts_near(self, point: Tensor) -> Rows:
        """Describe convex parts among which is that of the closest point to a point.

        All choices of half-spaces for the two rectangles with the least slack, of those that leave
        more than one, and for the others the half-space with the largest slack.
        """
        normals, offsets, valid = self._half_spaces()
        slack = offsets - (normals * point[..., None, None, :]).sum(-1)
        slack = torch.where(valid, slack, -torch.inf)
        largest, best = slack.max(-1)
        # No rectangle leaves more than these; the valid ones come first.
        most = self.dim * (self.dim + 1)
        order = torch.where(valid, -slack, torch.inf).argsort(-1)[..., :most]
        valid = valid.expand(slack.shape)
        order = torch.where(valid.gather(-1, order), order, best.unsqueeze(-1))
        ranked = torch.where(valid.sum(-1) > 1, largest, torch.inf).argsort(-1)
        parts = best.expand(most, most, *best.shape).clone()
        for axis in range(min(2, ranked.shape[-1])):
            rectangle = ranked[..., [axis]]
            row = rectangle.unsqueeze(-1).expand(*rectangle.shape, order.shape[-1])
            options = order.gather(-2, row).movedim(-1, 0)
            options = options.unsqueeze(axis).expand(*parts.shape[:-1], 1)
            parts = parts.scatter(-1, rectangle.expand_as(options), options)
        return _chosen(normals, offsets, valid, parts.flatten(0, 1))

    def _half_spaces(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return all half-spaces that each rectangle leaves, and which of them exist.

        Normals ``(*batch, m, n, d)`` and offsets ``(*batch, m, n)``.
        """
        slope, rising, pair = self._lines()
        identity = torch.eye(self.dim, dtype=slope.dtype, device=slope.device)
        normals = torch.cat([identity, -identity])
        j, k = slope.unsqueeze(-1), slope.unsqueeze(-2)
        share = torch.where(pair, j / torch.where(pair, j - k, 1), 0.0).unsqueeze(-1)
        crossing = share * normals + (1 - share) * normals.unsqueeze(-2)
        # All half-spaces, normal . a + t <= offset.
        normals = torch.cat([normals.expand(*slope.shape, -1), crossing.flatten(-3, -2)], -2)
        offsets = torch.cat([slope, torch.zeros_like(pair.flatten(-2), dtype=slope.dtype)], -1)
        return normals, offsets, torch.cat([rising, pair.flatten(-2)], -1)

    def _lines(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return the slopes in tau of the lines of `slack`, which rise, and which pairs cross.

        ``(*batch, m, 2d)`` twice, the low bounds' lines first, and ``(*batch, m, 2d, 2d)``: of a
        pair the first one rises and the second one falls. Infinite bounds have no line.
        """
        low, high = self._in_action_units()
        slope = torch.cat([low, -high], -1)
        finite = slope.isfinite()
        slope = torch.where(finite, slope, 0.0)
        pair = (finite & (slope > 0)).unsqueeze(-1) & (finite & (slope < 0)).unsqueeze(-2)
        return slope, finite & (slope >= 0), pair

    def _in_action_units(self) -> tuple[Tensor, Tensor]:
        """Return the rectangles' corners as seen from the position, each ``(*batch, m, d)``."""
        # Infinite bounds stay out of the arithmetic, whose gradient would be 0 times infinity.
        finite = self.rectangles.isfinite()
        corners = torch.where(finite, self.rectangles, 0.0)
        seen = (corners - self.position[..., None, None, :]) / self.step[..., None, None, None]
        low, high = torch.where(finite, seen, self.rectangles).unbind(-2)
        return low, high


@dataclass(frozen=True, eq=False)
class SeenFromOutside(VisibleRegion):
    r"""Moves that end in sight of another point than the position, next to it.

    What `VisibleRegion.eroded` returns. Rectangles that are grown by a rounding error may take in a
    position that is not in them. Seen from there would be nothing; here the move starts at the
    position, but what it must not touch is looked at from the nearest point outside of the grown
    rectangles, so that it leads away. As that point is no farther than what they have grown by, the
    straight move touches none of the rectangles themselves.

    Args:
        position: Points that are seen from, ``(*batch, d)``, in units of length.
        rectangles: Corners of the grown rectangles, ``(*batch, m, 2, d)``.
        step: Lengths moved by an action of one, ``(*batch,)``.
        moved: Actions that lead from the true position to that point, ``(*batch, d)``; 0 where
            they are the same.
    """

    moved: Tensor

    event_dims: ClassVar[Mapping[str, int]] = {**VisibleRegion.event_dims, "moved": 1}

    def contains(self, action: Tensor) -> Tensor:
        return self.slack(action) >= 0

    def slack(self, action: Tensor) -> Tensor:
        return super().slack(action - self.moved)

    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        return super().gauge(direction, anchor - self.moved)

    def bounding_box(self) -> Bounds:
        low, high = super().bounding_box()
        return Bounds(low + self.moved, high + self.moved)

    def eroded(self, magnitude: Tensor | float = 1.0) -> SeenFromOutside:
        inner = super().eroded(magnitude)
        return replace(inner, moved=inner.moved + self.moved, validate_args=False)

    def around(self, center: Tensor, radius: Tensor) -> Self:
        part = VisibleRegion.around(
            VisibleRegion(self.position, self.rectangles, self.step, validate_args=False),
            center,
            radius,
        )
        return type(self)(**part.fields(), moved=torch.zeros_like(center), validate_args=False)

    def part_near(self, point: Tensor) -> Rows:
        return self._from_the_position(super().part_near(point - self.moved))

    def parts_near(self, point: Tensor) -> Rows:
        return self._from_the_position(super().parts_near(point - self.moved))

    def _from_the_position(self, part: Rows) -> Rows:
        along = (part.normals * self.moved.unsqueeze(-2)).sum(-1)
        return replace(part, offsets=part.offsets + along)


def _chosen(normals: Tensor, offsets: Tensor, valid: Tensor, index: Tensor) -> Rows:
    """Return one half-space for each rectangle, by its index ``(*parts, *batch, m)``."""
    # Not take_along_dim, with which an exported program would be one for a single batch size.
    index = index.unsqueeze(-1)
    row = index.unsqueeze(-1).expand(*index.shape, normals.shape[-1])
    normal = normals.expand(*index.shape[:-1], -1, -1).gather(-2, row).squeeze(-2)
    offset = offsets.expand(*index.shape[:-1], -1).gather(-1, index).squeeze(-1)
    # In a rectangle the part is empty: 0 a + t <= -1.
    outside = valid.any(-1)
    normal = torch.where(outside.unsqueeze(-1), normal, 0.0)
    offset = torch.where(outside, offset, -1.0)
    return Rows(normal, offset, torch.ones_like(offset))
