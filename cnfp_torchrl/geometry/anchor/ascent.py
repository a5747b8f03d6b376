r"""Newton steps inwards for many states at once, in a fixed number of passes without a search.

Each step goes towards the analytic center of :math:`\{a : slack_j(a) \ge \tau\}`, where the level
:math:`\tau` follows the smallest slack. The weights :math:`\lambda \propto 1/(slack - \tau)` of the
inequalities certify how good a point is: with gradients g, for all x within the bounds

.. math:: \min_j slack_j(x) \le \sum_j \lambda_j (slack_j(a) + g_j \cdot (x - a)),

which near the analytic center hardly depends on x (weak duality; Boyd and Vandenberghe, Convex
Optimization, 2004, section 11.2.2).

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

LEVEL = 0.2
"""The distance of the level below the smallest slack, as a share of what that may still gain."""

LONGEST = 1.7
"""The largest length of a step, in Newton steps, which are short near an inequality."""

FALL = 0.5
"""The share of its distance from the level by which an inequality may come nearer in one step."""


_SMALL = 8
"""The largest dimension for which elimination side by side is the fastest."""


class _Cone(NamedTuple):
    """A cone's slack, ``size - |vector + matrix x|``, and the norm below which it has a tip."""

    matrix: Tensor
    vector: Tensor
    size: Tensor
    tip: Tensor


class _Sum(NamedTuple):
    """A sum's slack, ``size - upper . max(a, 0) + lower . max(-a, 0)``, a the action."""

    upper: Tensor
    lower: Tensor
    size: Tensor


class _Derivatives(NamedTuple):
    """Inverse slacks beyond the level at a point, and their derivatives.

    Attributes:
        inverse: inverses of all M inequalities, the sides of the boxes first, ``(M, B)``.
        gradient: gradients of the slacks of those behind the boxes, ``(M - 2 d, d, B)``.
        pull: sum of all gradients times the inverses, ``(d, B)``.
        lengths: norms that the slacks of the cones subtract, ``(B,)`` each.
    """

    inverse: Tensor
    gradient: Tensor
    pull: Tensor
    lengths: list[Tensor]


class Ascent:
    """Points that move inwards, and upper bounds of the best slack.

    Args:
        sets: sets of batch shapes that broadcast to that of the start; the first are the action
            bounds. Sets without a `superlevel` are left out, and of non-convex ones a convex part
            counts.
        start: points within the bounds, ``(*batch, d)``.
        upper: upper bounds of the best slack, such as half of the bounds' width, ``(*batch,)``.
    """

    def __init__(self, sets: Sequence[ConstraintSet], start: Tensor, upper: Tensor) -> None:
        self.shape, self.dim = start.shape[:-1], start.shape[-1]
        # Not shape.numel(), with which an exported program would be one for a single batch size.
        self.count = math.prod(self.shape)
        bounds = bounds_of(sets)
        # In units of the bounds' half widths, about their middle.
        low, high = self._last(bounds.low), self._last(bounds.high)
        self.middle, self.half = (low + high) / 2, (high - low) / 2
        self.x = (self._last(start) - self.middle) / self.half
        self.upper = self._last(upper, 0)
        self.tiny = torch.finfo(self.x.dtype).eps * self.half.amin(0)
        self.sees_all = all(type(s).part_near is ConstraintSet.part_near for s in sets)
        for box in sets[1:]:
            if isinstance(box, Box):
                low = torch.maximum(low, self._last(box.low))
                high = torch.minimum(high, self._last(box.high))
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
    def point(self) -> Tensor:
        """The points, ``(*batch, d)``."""
        return torch.addcmul(self.middle, self.half, self.x).mT.reshape(*self.shape, self.dim)

    @property
    def bound(self) -> Tensor:
        """Upper bounds of the best slack, ``(*batch,)``."""
        return self.upper.reshape(self.shape)

    def run(self, steps: int) -> None:
        """Take some steps, and improve the bounds with each of them."""
        for _ in range(steps):
            self._step(self._evaluate()[0])
        self._evaluate()

    def run_until(self, steps: int, share: float, depth: Tensor) -> tuple[Tensor, ...]:
        """Take steps until all points are deep enough or cannot be, and tell which are.

        Args:
            steps: largest number of steps.
            share: share of the best slack that is enough.
            depth: least slack that is enough, ``(*batch,)``.

        Returns:
            Points ``(B, d)``, upper bounds of the best slack, and whether the points are deep
            enough, ``(B,)`` each, side by side.
        """
        least, left = self._last(depth, 0), None
        anchor = upper = decided = self.x
        for step in range(steps + 1):
            at, slack = self._evaluate()
            deep = slack >= torch.maximum(least, share * self.upper)
            done = deep | (self.upper < -least)
            count = self.count - int(done.sum()) if step < steps else 0
            if 2 * count <= self.count:
                here = self._flat_point()
                if left is None:
                    anchor, upper, decided = here, self.upper, deep
                else:
                    # Only now and then: writing apart costs more than what is written.
                    anchor = anchor.index_copy(0, left, here)
                    upper = upper.index_copy(0, left, self.upper)
                    decided = decided.index_copy(0, left, deep)
                if not count:
                    break
                keep = (~done).nonzero().squeeze(-1)
                left = keep if left is None else left[keep]
                least, done = _chosen(least, keep), done[keep]
                at = self._select(keep, at)
            self._step(at, done)
        return anchor, upper, decided

    def _flat_point(self) -> Tensor:
        """Return the points side by side, ``(B, d)``."""
        return torch.addcmul(self.middle, self.half, self.x).mT

    def _select(self, keep: Tensor, at: _Derivatives) -> _Derivatives:
        """Go on with some of the points, and return their derivatives."""
        self.count = len(keep)
        for name in ("middle", "half", "x", "upper", "tiny", "sides", "slopes"):
            setattr(self, name, _chosen(getattr(self, name), keep))
        if self.normals is not None and self.offsets is not None:
            self.normals = _chosen(self.normals, keep)
            self.offsets = _chosen(self.offsets, keep)
        self.cones = [_Cone(*(_chosen(value, keep) for value in cone)) for cone in self.cones]
        self.sums = [_Sum(*(_chosen(value, keep) for value in each)) for each in self.sums]
        lengths = [_chosen(length, keep) for length in at.lengths]
        inverse, gradient, pull = (_chosen(value, keep) for value in at[:3])
        return _Derivatives(inverse, gradient, pull, lengths)

    def _evaluate(self) -> tuple[_Derivatives, Tensor]:
        """Return derivatives and the smallest slack at the points, and improve the bounds."""
        value = torch.addcmul(self.sides, self.slopes, self.x).flatten(0, 1)
        values, gradients, lengths = [value], [], []
        if self.normals is not None and self.offsets is not None:
            values.append(self.offsets + (self.normals * self.x).sum(1))
            gradients.append(self.normals)
        for cone in self.cones:
            white = cone.vector + (cone.matrix * self.x).sum(1)
            # Not `torch.linalg.vector_norm`, which is slow along the first dimension.
            length = white.square().sum(0).sqrt()
            values.append((cone.size - length).unsqueeze(0))
            # At the tip of the cone the gradient is 0, and the curvature would be infinite.
            lengths.append(torch.maximum(length, cone.tip))
            unit = white / -lengths[-1]
            gradients.append((cone.matrix * unit.unsqueeze(1)).sum(0, keepdim=True))
        for upper, lower, size in self.sums:
            at = torch.addcmul(self.middle, self.half, self.x)
            side = torch.where(at > 0, upper, lower)
            values.append((size - (side * at).sum(0)).unsqueeze(0))
            gradients.append((-side * self.half).unsqueeze(0))
        if len(values) > 1:
            value = torch.cat(values)
        least = value.amin(0)
        gap = torch.add(self.tiny, (self.upper - least).relu(), alpha=LEVEL)
        level = least - gap
        inverse = (value - level).reciprocal()
        below = inverse[: 2 * self.dim].unflatten(0, (2, self.dim))
        pull = (self.slopes * below).sum(0)
        gradient = value[:0, None] if not gradients else _stacked(gradients)
        if gradients:
            pull = pull + (inverse[2 * self.dim :].unsqueeze(1) * gradient).sum(0)
        # What the weighted mean of the slacks may become within the bounds.
        more = torch.addcmul(pull.abs(), pull, self.x, value=-1).sum(0) + len(value)
        self.upper = torch.fmin(self.upper, level + more / inverse.sum(0))
        return _Derivatives(inverse, gradient, pull, lengths), least

    def _step(self, at: _Derivatives, stays: Tensor | None = None) -> None:
        """Take a Newton step, shortened, from all points but those that stay."""
        inverse, rest = at.inverse[: 2 * self.dim], at.inverse[2 * self.dim :]
        diagonal = (self.slopes * inverse.unflatten(0, (2, self.dim))).square().sum(0)
        hessian = torch.diag_embed(diagonal.mT, dim1=0, dim2=1)
        if len(rest):
            scaled = rest.unsqueeze(1) * at.gradient
            hessian = hessian + (scaled.unsqueeze(1) * scaled.unsqueeze(2)).sum(0)
        first = len(rest) - len(self.cones) - len(self.sums)
        for place, (cone, length) in enumerate(zip(self.cones, at.lengths, strict=True), first):
            square = (cone.matrix.unsqueeze(1) * cone.matrix.unsqueeze(2)).sum(0)
            along = at.gradient[place].unsqueeze(0) * at.gradient[place].unsqueeze(1)
            hessian = hessian + rest[place] / length * (square - along)
        move = _solve(hessian, at.pull)
        changes = [(self.slopes * move).flatten(0, 1)]
        if len(rest):
            changes.append((at.gradient * move).sum(1))
        fall = (torch.cat(changes) * at.inverse).amin(0)
        share = (-FALL / fall.clamp(max=-1e-3)).clamp(max=LONGEST)
        if stays is not None:
            share = share.masked_fill(stays, 0)
            move = move.nan_to_num()
        self.x = torch.addcmul(self.x, share, move)

    def _rows(self, part: Rows) -> tuple[Tensor, Tensor]:
        """Return gradients ``(m, d, B)`` and the slacks in the middle ``(m, B)``."""
        normals, offsets = self._last(part.normals, 2), self._last(part.offsets)
        rates = self._last(part.rates)
        rates = rates.masked_fill(rates == 0, 1)
        normals, places = normals / rates.unsqueeze(1), offsets / rates
        places = places - (normals * self.middle).sum(1)
        # Rows that let every action pass are far away, not infinitely far: 0 times infinity is NaN.
        free = offsets.isinf()
        places = torch.where(free, 1e3 * self.half.sum(0), places)
        return (normals * -self.half).masked_fill(free.unsqueeze(1), 0), places

    def _cone(self, part: Cone) -> _Cone:
        rate = self._last(part.rate, 0)
        matrix, size = self._last(part.matrix, 2) / rate, self._last(part.size, 0) / rate
        vector = self._last(part.vector) / rate + (matrix * self.middle).sum(1)
        tip = 1e-3 * size + torch.finfo(size.dtype).tiny
        return _Cone(matrix * self.half, vector, size, tip)

    def _sum(self, part: KinkedSum) -> _Sum:
        rate = self._last(part.rate, 0)
        free = rate == 0
        rate = rate.masked_fill(free, 1)
        size = self._last(part.size, 0) / rate
        size = size.masked_fill(free, torch.finfo(rate.dtype).max ** 0.25)
        return _Sum(self._last(part.upper) / rate, self._last(part.lower) / rate, size)

    def _last(self, value: Tensor, events: int = 1) -> Tensor:
        """Return values ``(*batch, *event)`` as ``(*event, B)``, or with 1 where all are alike."""
        event = value.shape[value.ndim - events :]
        batch = value.shape[: value.ndim - events]
        if math.prod(batch) > 1 and batch != self.shape:
            value = value.expand((*self.shape, *event))
        return value.reshape(-1, *event).movedim(0, -1).contiguous()


def _chosen(value: Tensor, keep: Tensor) -> Tensor:
    """Return some values of a batch, or the one for all."""
    return value if value.shape[-1] == 1 else value.index_select(-1, keep)


def _stacked(parts: Sequence[Tensor]) -> Tensor:
    """Return parts ``(m, ..., B)`` behind each other, where some may be the same for all."""
    if len(parts) == 1:
        return parts[0]
    batch = max(part.shape[-1] for part in parts)
    return torch.cat([part.expand(*part.shape[:-1], batch) for part in parts])


def _solve(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve with positive definite matrices ``(d, d, B)``, by elimination where they are small."""
    if len(right) > _SMALL and not torch.compiler.is_exporting():
        solution = torch.linalg.solve_ex(matrix.permute(2, 0, 1), right.mT.unsqueeze(-1))[0]
        return solution.squeeze(-1).mT
    rest = torch.cat([matrix, right.unsqueeze(1)], 1)
    for k in range(len(right)):
        row = rest[k, 1:] / rest[k, 0]
        rest = torch.addcmul(rest[:, 1:], rest[:, :1], row, value=-1)
        rest[k] = row
    return rest[:, 0]
