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


class _Cone(NamedTuple):
    """A cone's slack, ``(size - |vector + matrix x|) / rate``, and the square of its matrix."""

    matrix: Tensor
    vector: Tensor
    size: Tensor
    rate: Tensor
    square: Tensor


class _Derivatives(NamedTuple):
    """Inverse slacks beyond the level at a point, and their derivatives.

    Attributes:
        inverse: inverses of all M inequalities, the sides of the boxes first, ``(M, B)``.
        gradient: gradients of the slacks of those behind the boxes, ``(M - 2 d, d, B)``.
        pull: sum of all gradients times the inverses, ``(d, B)``.
        curvature: terms of the Hessian for the curvature of the cones, ``(d, d, B)`` each.
    """

    inverse: Tensor
    gradient: Tensor
    pull: Tensor
    curvature: list[Tensor]


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
        bounds = bounds_of(sets)
        # In units of the bounds' half widths, about their middle.
        middle, half = (bounds.low + bounds.high) / 2, (bounds.high - bounds.low) / 2
        self.middle, self.half = self._last(middle), self._last(half)
        self.x = (self._last(start) - self.middle) / self.half
        self.upper = self._last(upper, 0)
        self.least = torch.full_like(self.upper, -torch.inf)
        self.sees_all = all(type(s).part_near is ConstraintSet.part_near for s in sets)
        boxes = [box for box in sets if isinstance(box, Box)]
        high = [self._last(box.high - middle) for box in boxes]
        low = [self._last(middle - box.low) for box in boxes]
        self.sides = torch.cat([_least(high), _least(low)])
        self.normals: Tensor | None = None
        self.offsets: Tensor | None = None
        self.cones: list[_Cone] = []
        self.sums: list[tuple[Tensor, Tensor, Tensor]] = []
        rows = []
        for constraint_set in sets:
            part = None if isinstance(constraint_set, Box) else constraint_set.superlevel()
            if isinstance(part, Rows):
                rows.append(self._rows(part, middle, half))
            elif isinstance(part, Cone):
                self.cones.append(self._cone(part, middle, half))
            elif isinstance(part, KinkedSum):
                self.sums.append(self._sum(part))
            elif not isinstance(constraint_set, Box):
                self.sees_all = False
        if rows:
            self.normals = torch.cat([normal for normal, _ in rows])
            self.offsets = torch.cat([offset for _, offset in rows])

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
            self._step(self._evaluate())
        self._evaluate()

    def run_until(self, steps: int, share: float, depth: Tensor) -> Tensor:
        """Take steps until all points are deep enough or cannot be, and tell which are.

        Args:
            steps: largest number of steps.
            share: share of the best slack that is enough.
            depth: least slack that is enough, ``(*batch,)``.

        Returns:
            Whether the points are deep enough, boolean ``(*batch,)``.
        """
        least = self._last(depth, 0)
        for step in range(steps + 1):
            at = self._evaluate()
            deep = (self.least >= least) & (self.least >= share * self.upper)
            if step == steps or bool((deep | (self.upper < -least)).all()):
                break
            # Those that are deep enough stay.
            self._step(at, deep)
        return deep.view(self.shape)

    def _evaluate(self) -> _Derivatives:
        """Return the derivatives at the points, and improve the bounds by them."""
        step = self.half * self.x
        values, gradients, curved = [self.sides - torch.cat([step, -step])], [], []
        if self.normals is not None and self.offsets is not None:
            values.append(self.offsets + (self.normals * self.x).sum(1))
            gradients.append(self.normals)
        for cone in self.cones:
            white = cone.vector + (cone.matrix * self.x).sum(1)
            # Not `torch.linalg.vector_norm`, which is slow along the first dimension.
            length = white.square().sum(0).sqrt()
            values.append(((cone.size - length) / cone.rate).unsqueeze(0))
            # At the tip of the cone the gradient is 0, and the curvature would be infinite.
            length = torch.maximum(length, 1e-3 * cone.size + torch.finfo(length.dtype).tiny)
            unit = white / (length * cone.rate)
            gradients.append(-(cone.matrix * unit.unsqueeze(1)).sum(0, keepdim=True))
            curved.append(cone.rate / length)
        for upper, lower, size in self.sums:
            at = self.middle + step
            side = torch.where(at > 0, upper, lower)
            values.append((size - (side * at).sum(0)).unsqueeze(0))
            gradients.append((-side * self.half).unsqueeze(0))
        value = torch.cat(values) if len(values) > 1 else values[0]
        least = self.least = value.amin(0)
        tiny = torch.finfo(least.dtype).eps * self.half.amin(0)
        gap = torch.add(tiny, (self.upper - least).relu(), alpha=LEVEL)
        inverse = (value - (least - gap)).reciprocal()
        above, below, rest = inverse.split([self.dim, self.dim, len(inverse) - 2 * self.dim])
        pull = self.half * (below - above)
        gradient = (
            torch.cat(gradients) if len(gradients) > 1 else (gradients or [value[:0, None]])[0]
        )
        if gradients:
            pull = pull + (rest.unsqueeze(1) * gradient).sum(0)
        # What the weighted mean of the slacks may become within the bounds.
        mean = (inverse * value).sum(0) + (pull.abs() - pull * self.x).sum(0)
        self.upper = torch.fmin(self.upper, mean / inverse.sum(0))
        first = len(rest) - len(self.cones) - len(self.sums)
        curvature = []
        for place, (cone, bend) in enumerate(zip(self.cones, curved, strict=True), first):
            along = gradient[place].unsqueeze(0) * gradient[place].unsqueeze(1)
            curvature.append((rest[place] * bend) * (cone.square - along))
        return _Derivatives(inverse, gradient, pull, curvature)

    def _step(self, at: _Derivatives, stays: Tensor | None = None) -> None:
        """Take a Newton step, shortened, from all points but those that stay."""
        above, below, rest = at.inverse.split([self.dim, self.dim, len(at.inverse) - 2 * self.dim])
        hessian = torch.diag_embed(
            (self.half.square() * (above.square() + below.square())).mT, dim1=0, dim2=1
        )
        if len(rest):
            scaled = rest.unsqueeze(1) * at.gradient
            hessian = hessian + (scaled.unsqueeze(1) * scaled.unsqueeze(2)).sum(0)
        for curvature in at.curvature:
            hessian = hessian + curvature
        move = _solve(hessian, at.pull)
        step = self.half * move
        changes = [-step, step]
        if len(rest):
            changes.append((at.gradient * move).sum(1))
        fall = (torch.cat(changes) * at.inverse).amin(0)
        share = (-FALL / fall.clamp(max=-1e-3)).clamp(max=LONGEST)
        if stays is not None:
            share = share.masked_fill(stays, 0)
            move = move.nan_to_num()
        self.x = torch.addcmul(self.x, share, move)

    def _rows(self, part: Rows, middle: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
        """Return gradients ``(m, d, B)`` and the slacks in the middle ``(m, B)``."""
        rates = part.rates.masked_fill(part.rates == 0, 1)
        normals = part.normals / rates.unsqueeze(-1)
        offsets = part.offsets / rates - (normals * middle.unsqueeze(-2)).sum(-1)
        # Rows that let every action pass are far away, not infinitely far: 0 times infinity is NaN.
        far = 1e3 * half.sum(-1, keepdim=True)
        offsets = torch.where(part.offsets.isinf(), far, offsets)
        normals = normals.masked_fill(part.offsets.isinf().unsqueeze(-1), 0)
        return self._last(-normals * half.unsqueeze(-2), 2), self._last(offsets)

    def _cone(self, part: Cone, middle: Tensor, half: Tensor) -> _Cone:
        matrix = part.matrix * half.unsqueeze(-2)
        vector = part.vector + (part.matrix * middle.unsqueeze(-2)).sum(-1)
        matrix, rate = self._last(matrix, 2), self._last(part.rate, 0)
        relative = matrix / rate
        # (B, d, d) would be multiplied one by one.
        square = (relative.unsqueeze(1) * relative.unsqueeze(2)).sum(0)
        return _Cone(matrix, self._last(vector), self._last(part.size, 0), rate, square)

    def _sum(self, part: KinkedSum) -> tuple[Tensor, Tensor, Tensor]:
        free = part.rate == 0
        rate = part.rate.masked_fill(free, 1)
        size = (part.size / rate).masked_fill(free, torch.finfo(rate.dtype).max ** 0.25)
        slopes = (slope / rate.unsqueeze(-1) for slope in (part.upper, part.lower))
        upper, lower = (self._last(slope) for slope in slopes)
        return upper, lower, self._last(size, 0)

    def _last(self, value: Tensor, events: int = 1) -> Tensor:
        """Return values ``(*batch, *event)`` as ``(*event, B)``."""
        event = value.shape[value.ndim - events :]
        flat = value.expand((*self.shape, *event)).reshape(-1, *event)
        return flat.movedim(0, -1).contiguous()


def _least(values: Sequence[Tensor]) -> Tensor:
    return values[0] if len(values) == 1 else torch.stack(list(values)).amin(0)


def _solve(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve with positive definite matrices ``(d, d, B)``, by elimination where they are small."""
    if len(right) > 4 and not torch.compiler.is_exporting():
        solution = torch.linalg.solve_ex(matrix.permute(2, 0, 1), right.mT.unsqueeze(-1))[0]
        return solution.squeeze(-1).mT
    rest = torch.cat([matrix, right.unsqueeze(1)], 1)
    rows = []
    for _ in range(len(right)):
        rows.append(rest[0, 1:] / rest[0, 0])
        rest = rest[1:, 1:] - rest[1:, :1] * rows[-1]
    known = rows.pop()
    for row in reversed(rows):
        known = torch.cat([row[-1:] - (row[:-1] * known).sum(0, keepdim=True), known])
    return known
