r"""Newton steps inwards for many states at once, in a fixed number of passes without a search.

A primal-dual interior-point method for the largest level t that all slacks reach: a step goes
towards points at which weights :math:`\lambda_j` and rooms :math:`slack_j(a) - t` of all
inequalities have the same product, a share of their mean product so far. The weights certify how
good a point is: with gradients g, for all x within the bounds and :math:`\sum_j \lambda_j = 1`,

.. math:: \min_j slack_j(x) \le \sum_j \lambda_j (slack_j(a) + g_j \cdot (x - a)),

whatever the weights are (weak duality; Boyd and Vandenberghe, Convex Optimization, 2004, sections
5.9 and 11.7). No predictor comes before a step, as in the search (`interior_point`), which needs
many digits more: two or three steps are usual here.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from cnfp_torchrl.geometry.anchor.inequalities import Derivatives, Inequalities, Slacks, chosen
from cnfp_torchrl.geometry.constraint_set import ConstraintSet

START = 0.1
"""The first level's distance below the smallest slack, as a share of what that may still gain."""

CENTERING = 0.2
"""The product of weight and room that a step aims at, as a share of the mean one before."""

LEAST_ROOM = 0.5
"""The least distance of a later level below the smallest slack, as a share of the mean product.

Without it an inequality that is met early holds all steps after it short.
"""

ROUNDING_OFF = 0.1
"""The width over which the d terms of a sum are rounded off, as a share of the mean product / d."""

FRACTION = 0.95
"""The share of the way to the boundary that a step may go."""

ENOUGH = 0.5
"""The share of the best slack from which on a point stays, where the number of steps is fixed."""

_SMALL, _FEW = 10, 256
"""Up to this many unknowns, and from this many states on, elimination side by side is faster."""

_MANY = 128
"""The number of states from which on it is faster to leave out half of them."""


class Ascent:
    """Points that move inwards, and upper bounds of the best slack.

    Args:
        sets: Sets of batch shapes that broadcast to that of the start; the first are the action
            bounds. Sets without a `superlevel` are left out, and of non-convex ones a convex part
            counts.
        start: Points within the bounds, ``(*batch, d)``.
        upper: Upper bounds of the best slack, such as half of the bounds' width, ``(*batch,)``.
    """

    def __init__(self, sets: Sequence[ConstraintSet], start: Tensor, upper: Tensor) -> None:
        self.of = of = Inequalities(sets, start.shape[:-1])
        self.x = (of.batch_last(start) - of.middle) / of.half
        self.upper = torch.fmin(of.batch_last(upper, 0), of.bound())
        self.tiny = torch.finfo(self.x.dtype).eps * of.half.amin(0)
        self.weights: Tensor | None = None
        self.level = self.mean = self.upper

    @property
    def point(self) -> Tensor:
        """The points, ``(*batch, d)``."""
        return self.of.action(self.x).mT.reshape(*self.of.shape, self.of.dim)

    @property
    def bound(self) -> Tensor:
        """Upper bounds of the best slack, ``(*batch,)``."""
        return self.upper.reshape(self.of.shape)

    def run(self, steps: int) -> None:
        """Take some steps, and improve the bounds with each of them."""
        for _ in range(steps):
            slacks = self.of.slacks(self.x)
            self._step(self._evaluate(slacks), slacks.least >= ENOUGH * self.upper)
        self._evaluate(self.of.slacks(self.x))

    def run_until(
        self, steps: int, share: float, depth: Tensor, *, reads: bool = True
    ) -> tuple[Tensor, ...]:
        """Take steps until all points are deep enough or cannot be, and tell which are.

        Args:
            steps: The largest number of steps.
            share: The share of the best slack that is enough.
            depth: The least slack that is enough, ``(*batch,)``.
            reads: Whether it is read on the host which points need more steps. Otherwise all steps
                are taken, which move those alone, too.

        Returns:
            Points ``(B, d)``, upper bounds of the best slack, and whether the points are deep
            enough, ``(B,)`` each, side by side.
        """
        least, left = self.of.batch_last(depth, 0), None
        done = torch.zeros_like(least, dtype=torch.bool)
        anchor = upper = decided = self.x
        slacks, at = self.of.slacks(self.x), None
        # Before the first step twice: the sets' own ranges alone decide many states.
        for check in range(steps + 2):
            if at is not None:
                self._step(at, done)
                slacks = self.of.slacks(self.x)
            if check:
                at = self._evaluate(slacks)
            deep = slacks.least >= torch.maximum(least, share * self.upper)
            done = deep | (self.upper < -least)
            count = 0 if check > steps else len(done)
            if count and reads:
                count -= int(done.sum())
            if not count or (2 * count <= len(done) and len(done) >= _MANY):
                here = self.of.action(self.x).mT
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
                least, done = chosen(least, keep), done[keep]
                self._select(keep)
                slacks, at = slacks.select(keep), at and at.select(keep)
        return anchor, upper, decided

    def _select(self, keep: Tensor) -> None:
        """Go on with some of the points."""
        self.of.select(keep)
        for name in ("x", "upper", "tiny", "weights", "level", "mean"):
            if (value := getattr(self, name)) is not None:
                setattr(self, name, chosen(value, keep))

    def _evaluate(self, slacks: Slacks) -> Derivatives:
        """Return derivatives at the points, and improve the bounds."""
        of, x = self.of, self.x
        begins, least = self.weights is None, slacks.least
        if begins:
            self.mean = torch.add(self.tiny, (self.upper - least).relu(), alpha=START)
        # Rounded off sums are smaller by the width of each of their terms at most.
        below = (1 if begins else LEAST_ROOM) + (ROUNDING_OFF if of.sums else 0)
        level = torch.sub(least - self.tiny, self.mean, alpha=below)
        self.level = level if begins else torch.minimum(self.level, level)
        at = of.derivatives(x, slacks, self.level, ROUNDING_OFF / of.dim * self.mean)
        if self.weights is None:
            inverse = at.room.reciprocal()
            self.weights = inverse / inverse.sum(0)
        near, rest = self.weights.split([2 * of.dim, len(at.gradient)])
        pull, total = (of.slopes * near.unflatten(0, (2, of.dim))).sum(0), near.sum(0)
        if len(rest):
            pulls = (rest.unsqueeze(1) * at.gradient).sum(0)
            pull, total = pull + pulls[:-1], total - pulls[-1]
        product = (self.weights * at.room).sum(0)
        self.mean = product / len(at.room)
        # What the weighted mean of the rooms may become within the bounds.
        most = product + torch.addcmul(pull.abs(), pull, x, value=-1).sum(0)
        for row, gain in enumerate(at.gains, len(at.room) - len(at.gains)):
            most = torch.addcmul(most, self.weights[row], gain)
        self.upper = torch.fmin(self.upper, self.level + most / total)
        return at

    def _step(self, at: Derivatives, stays: Tensor) -> None:
        """Take a Newton step, shortened, from all points but those that stay."""
        of, weights, room = self.of, self.weights, at.room
        assert weights is not None
        # What the products of weights and rooms aim at, and what they are, in units of the room's
        # and of its square.
        split = [2 * of.dim, len(at.gradient)]
        wanted, stiff = CENTERING * self.mean / room, weights / room
        (wanted_near, wanted_rest), (near, rest) = wanted.split(split), stiff.split(split)
        wanted_near, near = (v.unflatten(0, (2, of.dim)) for v in (wanted_near, near))
        sloped = of.slopes * near
        diagonal, cross = (of.slopes * sloped).sum(0), sloped.sum(0)
        for row, curvature in enumerate(at.curvatures, len(room) - len(at.curvatures)):
            diagonal = torch.addcmul(diagonal, weights[row], curvature)
        corner = near.sum((0, 1)).unsqueeze(0)
        hessian = torch.diag_embed(torch.cat([diagonal, corner]).mT, dim1=0, dim2=1)
        hessian[:-1, -1].sub_(cross)
        hessian[-1, :-1].sub_(cross)
        right = [(of.slopes * wanted_near).sum(0), 1 - wanted_near.sum((0, 1)).unsqueeze(0)]
        pull = torch.cat(right)
        if len(rest):
            left, factors = [rest.unsqueeze(1) * at.gradient], [at.gradient]
            first = len(room) - len(at.roots) - len(at.curvatures)
            for row, (root, height) in enumerate(zip(at.roots, at.heights, strict=True), first):
                left.append(root * (weights[row] / height))
                factors.append(root)
            scaled, other = (torch.cat(v) if at.roots else v[0] for v in (left, factors))
            hessian += (scaled.unsqueeze(1) * other.unsqueeze(2)).sum(0)
            pull = pull + (wanted_rest.unsqueeze(1) * at.gradient).sum(0)
        # Where rounding error is all that is left, there may be infinities.
        move = _solve(hessian, pull).nan_to_num(posinf=0.0, neginf=0.0)
        changes = [torch.addcmul(-move[-1], of.slopes, move[:-1]).flatten(0, 1)]
        if len(rest):
            changes.append((at.gradient * move).sum(1))
        rise = torch.cat(changes) / room
        growth = wanted / weights - 1 - rise
        for root, height in zip(at.roots, at.heights, strict=True):
            rise = torch.cat([rise, -_steepness(root, 2 * height, move)])
        share, along = (-FRACTION / v.amin(0).clamp(max=-FRACTION) for v in (rise, growth))
        share = share.masked_fill(stays, 0)
        self.x = torch.addcmul(self.x, share, move[:-1]).clamp(-1, 1)
        self.level = torch.addcmul(self.level, share, move[-1])
        self.weights = torch.addcmul(weights, weights * along, growth)


def _steepness(root: Tensor, height: Tensor, move: Tensor) -> Tensor:
    """Return the inverse of the largest step that does not leave a cone, ``(1, B)``.

    Args:
        root: The matrix R of the cone's curvature, ``(k, d + 1, B)``.
        height: The distance h of the level from the cone's tip, ``(B,)``.
        move: Step in point and level, ``(d + 1, B)``.
    """
    # It is left where h^2 - |w|^2 is 0, a quadratic in the step.
    image = root[:, -1] * height
    change = (root[:, :-1] * move[:-1]).sum(1)
    length = image.square().sum(0).sqrt()
    room = (height - length) * (height + length)
    along = torch.addcmul((image * change).sum(0), height, move[-1])
    curved = move[-1].square() - change.square().sum(0)
    above = torch.addcmul(along.square(), curved, room, value=-1).relu().sqrt()
    return ((along + above) / room).unsqueeze(0)


def _solve(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve with positive definite matrices ``(n, n, B)``, by elimination where they are small."""
    compiles = torch.compiler.is_compiling()
    side_by_side = len(right) <= _SMALL and (compiles or right.shape[-1] >= _FEW)
    if not (side_by_side or torch.compiler.is_exporting()):
        solution = torch.linalg.solve_ex(matrix.permute(2, 0, 1), right.mT.unsqueeze(-1))[0]
        return solution.squeeze(-1).mT
    rest = torch.cat([matrix, right.unsqueeze(1)], 1)
    for k in range(len(right)):
        row = rest[k, 1:] / rest[k, 0]
        rest = torch.addcmul(rest[:, 1:], rest[:, :1], row, value=-1)
        rest[k] = row
    return rest[:, 0]
