r"""Inequalities "slack at least t" of many states, with their derivatives in action and level t.

Rows are linear. A cone :math:`|w| \le h`, with :math:`h = size - t`, is the inequality
:math:`h - |w|^2 / h \ge 0`, which has no tip: it is concave and smooth in action and level
together. A kinked term :math:`|u|` of a sum is rounded off to :math:`\sqrt{u^2 + \epsilon^2}`.

The batch comes last in all tensors here: so many small problems are solved fastest side by side.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from cnfp_torchrl.geometry.anchor.depth import bounds_of
from cnfp_torchrl.geometry.box import Box
from cnfp_torchrl.geometry.constraint_set import ConstraintSet
from cnfp_torchrl.geometry.superlevel import Cone, KinkedSum, Rows


class _Cone(NamedTuple):
    """A cone's slack, ``size - |vector + matrix x|``."""

    matrix: Tensor
    vector: Tensor
    size: Tensor


class _Sum(NamedTuple):
    """A sum's slack, ``size - upper . max(a, 0) + lower . max(-a, 0)``, a the action."""

    upper: Tensor
    lower: Tensor
    size: Tensor


class Slacks(NamedTuple):
    """Slacks at points.

    Attributes:
        value: Slacks of all M inequalities, ``(M, B)``: of the sides of the boxes, and behind them
            of rows, cones and sums.
        least: The smallest ones, ``(B,)``.
        images: Vectors w of the cones, ``(k, B)`` each.
        lengths: Their lengths, ``(1, B)`` each.
    """

    value: Tensor
    least: Tensor
    images: list[Tensor]
    lengths: list[Tensor]

    def select(self, keep: Tensor) -> Slacks:
        """Return some batch elements."""
        images, lengths = ([chosen(v, keep) for v in values] for values in self[2:])
        return Slacks(chosen(self.value, keep), chosen(self.least, keep), images, lengths)


class Derivatives(NamedTuple):
    """Inequalities at points and levels, and their derivatives in both.

    Attributes:
        room: The amount by which all inequalities hold, ``(M, B)``.
        gradient: Gradients of those behind the boxes, ``(M - 2 d, d + 1, B)``.
        roots: Matrices R of the cones' curvatures :math:`2 R^T R / h`, ``(k, d + 1, B)`` each.
        heights: Half heights :math:`h / 2` of the cones, ``(B,)`` each.
        curvatures: Curvatures of the sums along each component, ``(d, B)`` each.
        gains: The amounts by which slacks of sums lie above their linearizations at most, ``(B,)``
            each.
    """

    room: Tensor
    gradient: Tensor
    roots: list[Tensor]
    heights: list[Tensor]
    curvatures: list[Tensor]
    gains: list[Tensor]

    def select(self, keep: Tensor) -> Derivatives:
        """Return some batch elements."""
        others = ([chosen(value, keep) for value in values] for values in self[2:])
        return Derivatives(chosen(self.room, keep), chosen(self.gradient, keep), *others)


class Inequalities:
    """The inequalities of some sets, in half widths x of the bounds about their middle.

    Args:
        sets: Sets of batch shapes that broadcast; the first are the action bounds. Sets without a
            `superlevel` are left out, and of non-convex ones a convex part counts.
        shape: Their batch shape, with B elements.
    """

    def __init__(self, sets: Sequence[ConstraintSet], shape: torch.Size) -> None:
        self.shape = shape
        bounds = bounds_of(sets)
        low, high = self.batch_last(bounds.low), self.batch_last(bounds.high)
        self.middle, self.half = (low + high) / 2, (high - low) / 2
        self.sees_all = all(s.is_convex() for s in sets)
        for box in sets[1:]:
            if isinstance(box, Box):
                low = torch.maximum(low, self.batch_last(box.low))
                high = torch.minimum(high, self.batch_last(box.high))
        sides = torch.broadcast_tensors(high - self.middle, self.middle - low)
        self.sides = torch.stack(sides)
        self.slopes = torch.stack([-self.half, self.half])
        self.normals: Tensor | None = None
        self.offsets: Tensor | None = None
        self.cones: list[_Cone] = []
        self.sums: list[_Sum] = []
        rows = []
        for constraint_set in sets:
            part = None if isinstance(constraint_set, Box) else constraint_set.superlevel()
            if isinstance(part, Rows):
                rows.append(self._rows(part))
            elif isinstance(part, Cone):
                self.cones.append(self._cone(part))
            elif isinstance(part, KinkedSum):
                self.sums.append(self._sum(part))
            elif not isinstance(constraint_set, Box):
                self.sees_all = False
        if rows:
            self.normals, self.offsets = (_stacked(parts) for parts in zip(*rows, strict=True))

    @property
    def dim(self) -> int:
        """The dimension d of the actions."""
        return len(self.half)

    def action(self, x: Tensor) -> Tensor:
        """Return the actions ``(d, B)`` of points."""
        return torch.addcmul(self.middle, self.half, x)

    def select(self, keep: Tensor) -> None:
        """Go on with some of the batch elements."""
        for name in ("middle", "half", "sides", "slopes", "normals", "offsets"):
            if (value := getattr(self, name)) is not None:
                setattr(self, name, chosen(value, keep))
        self.cones = [_Cone(*(chosen(value, keep) for value in cone)) for cone in self.cones]
        self.sums = [_Sum(*(chosen(value, keep) for value in terms)) for terms in self.sums]

    def bound(self) -> Tensor:
        """Return upper bounds of the smallest slack, from each slack's own range, ``(B,)``."""
        least = (self.sides.sum(0) / 2).amin(0)
        if self.normals is not None and self.offsets is not None:
            most = self.offsets + self.normals[:, :-1].abs().sum(1)
            least = torch.fmin(least, most.amin(0))
        for cone in self.cones:
            reach = cone.matrix.square().sum(0).sqrt().sum(0)
            nearest = cone.vector.square().sum(0).sqrt() - reach
            least = torch.fmin(least, cone.size - nearest.relu())
        for upper, lower, size in self.sums:
            ends = self.middle - self.half, self.middle + self.half
            places = (*ends, torch.zeros_like(ends[0]).clamp(*ends))
            terms = torch.stack([torch.maximum(upper * a, lower * a) for a in places])
            least = torch.fmin(least, size - terms.amin(0).sum(0))
        return least

    def slacks(self, x: Tensor) -> Slacks:
        """Return the slacks at points ``(d, B)``."""
        values = [torch.addcmul(self.sides, self.slopes, x).flatten(0, 1)]
        if self.normals is not None and self.offsets is not None:
            values.append(self.offsets + (self.normals[:, :-1] * x).sum(1))
        images = [cone.vector + (cone.matrix * x).sum(1) for cone in self.cones]
        # Not `torch.linalg.vector_norm`, which is slow along the first dimension.
        lengths = [image.square().sum(0, keepdim=True).sqrt() for image in images]
        values += [cone.size - length for cone, length in zip(self.cones, lengths, strict=True)]
        if self.sums:
            action = self.action(x)
            for upper, lower, size in self.sums:
                terms = torch.maximum(upper * action, lower * action)
                values.append(size - terms.sum(0, keepdim=True))
        value = torch.cat(values) if len(values) > 1 else values[0]
        return Slacks(value, value.amin(0), images, lengths)

    def derivatives(self, x: Tensor, at: Slacks, level: Tensor, width: Tensor) -> Derivatives:
        """Return rooms and derivatives at points and at levels below all slacks.

        Args:
            x: Points, ``(d, B)``.
            at: Slacks at the points.
            level: Levels ``(B,)``.
            width: Widths over which the terms of a sum are rounded off, ``(B,)``.
        """
        room = at.value - level
        gradients = [] if self.normals is None else [self.normals]
        roots, heights = [], []
        row = len(room) - len(self.cones) - len(self.sums)
        for cone, image, length in zip(self.cones, at.images, at.lengths, strict=True):
            half = (cone.size - level) / 2
            share = length / (2 * half)
            room[row] *= 1 + share.squeeze(0)
            slope = (cone.matrix * image.unsqueeze(1)).sum(0) / -half
            gradients.append(torch.cat([slope, -1 - share.square()]).unsqueeze(0))
            matrix = cone.matrix.expand(-1, -1, x.shape[-1])
            roots.append(torch.cat([matrix, (image / (2 * half)).unsqueeze(1)], 1))
            heights.append(half)
            row += 1
        curvatures, gains = [], []
        for upper, lower, _ in self.sums:
            spread = (upper - lower) / 2
            term = spread * self.action(x)
            length = torch.addcmul(width.square(), term, term).sqrt()
            room[row] -= (length - term.abs()).sum(0)
            turn, rise = width / length, torch.addcmul((upper + lower) / 2, spread, term / length)
            gradient = torch.cat([-rise * self.half, rise.new_full((1, x.shape[-1]), -1.0)])
            gradients.append(gradient.unsqueeze(0))
            curvatures.append((self.half * spread * turn).square() / length)
            gains.append((width * turn).sum(0))
            row += 1
        gradient = _stacked(gradients) if gradients else room[:0, None]
        return Derivatives(room, gradient, roots, heights, curvatures, gains)

    def batch_last(self, value: Tensor, events: int = 1) -> Tensor:
        """Return values ``(*batch, *event)`` as ``(*event, B)``, or with 1 where all are alike."""
        event = value.shape[value.ndim - events :]
        batch = value.shape[: value.ndim - events]
        if math.prod(batch) > 1 and batch != self.shape:
            value = value.expand((*self.shape, *event))
        return value.reshape(-1, *event).movedim(0, -1).contiguous()

    def _rows(self, part: Rows) -> tuple[Tensor, Tensor]:
        """Return gradients ``(m, d + 1, B)`` and the slacks in the middle ``(m, B)``."""
        normals, offsets = self.batch_last(part.normals, 2), self.batch_last(part.offsets)
        rates = self.batch_last(part.rates)
        rates = rates.masked_fill(rates == 0, 1)
        normals, places = normals / rates.unsqueeze(1), offsets / rates
        places = places - (normals * self.middle).sum(1)
        # Rows that let every action pass are far away, not infinitely far: 0 times infinity is NaN.
        free = offsets.isinf()
        places = torch.where(free, 1e3 * self.half.sum(0), places)
        slopes = (normals * -self.half).masked_fill(free.unsqueeze(1), 0)
        return torch.cat([slopes, -torch.ones_like(slopes[:, :1])], 1), places

    def _cone(self, part: Cone) -> _Cone:
        rate = self.batch_last(part.rate, 0)
        matrix, size = self.batch_last(part.matrix, 2) / rate, self.batch_last(part.size, 0) / rate
        vector = self.batch_last(part.vector) / rate + (matrix * self.middle).sum(1)
        return _Cone(matrix * self.half, vector, size)

    def _sum(self, part: KinkedSum) -> _Sum:
        rate = self.batch_last(part.rate, 0)
        free = rate == 0
        rate = rate.masked_fill(free, 1)
        size = self.batch_last(part.size, 0) / rate
        size = size.masked_fill(free, torch.finfo(rate.dtype).max ** 0.25)
        return _Sum(self.batch_last(part.upper) / rate, self.batch_last(part.lower) / rate, size)


def chosen(value: Tensor, keep: Tensor) -> Tensor:
    """Return some values of a batch, or the one for all."""
    return value if value.shape[-1] == 1 else value.index_select(-1, keep)


def _stacked(parts: Sequence[Tensor]) -> Tensor:
    """Return parts ``(m, ..., B)`` behind each other, where some may be the same for all."""
    if len(parts) == 1:
        return parts[0]
    batch = max(part.shape[-1] for part in parts)
    return torch.cat([part.expand(*part.shape[:-1], batch) for part in parts])
