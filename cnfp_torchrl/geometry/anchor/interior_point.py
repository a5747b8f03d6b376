r"""A batched primal-dual interior-point method for the largest smallest slack of convex sets.

Newton's method goes towards :math:`s \circ z = \mu`, with the slacks s of rows and cones and their
weights z, scaled such that both are the same vector (Nesterov and Todd 1997). Predictor and
corrector share one factorization (Mehrotra 1992; for cones: Vandenberghe, The CVXOPT linear and
quadratic cone program solvers, 2010).

Every point on the way is strictly feasible, so its slack is a lower bound of the best one. Whatever
the weights are, they certify an upper bound, by weak duality, with what their gradients leave over
bounded over the action bounds: no bound rests on convergence.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import NamedTuple, Self, TypeAlias

import torch
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.geometry.anchor.program import Program

MAX_ITERATIONS = 60
"""The number of steps after which the best point so far is taken; 6 are usual, 20 rare."""

_FRACTION = 0.995
"""The share of the way to the boundary that a step may go."""


class Best(NamedTuple):
    """The best found actions ``(B, d)``, their slacks, and upper bounds of the slack ``(B,)``."""

    action: Tensor
    slack: Tensor
    upper_bound: Tensor


Settled: TypeAlias = Callable[[Tensor, Tensor, Tensor], Tensor]
"""From lower and upper bounds of the best t, and the problems' indices: which need no more work."""


def maximize_slack(problem: Program, start: Tensor, settled: Settled) -> Best:
    """Find actions whose smallest slack is large, and certified upper bounds of it.

    Stops for each problem as soon as its bounds say enough: at once where a set is so far from the
    bounds that the largest slack within them does, which Newton's method could not tell from
    rounding error. Where rounding error keeps the bounds apart, the best point so far is returned:
    its slack is true, and no more is claimed for the upper bound.

    Args:
        problem: B problems in float64, with rows that bound the actions on all sides.
        start: points strictly inside of what is not on trial, ``(B, d)``.
        settled: function that tells which problems need no more work.
    """
    unit = problem.unit.squeeze(-1)
    x = problem.start(start)
    found, largest, bound = x.clone(), torch.empty_like(unit), torch.empty_like(unit)
    left = torch.arange(len(start), device=start.device)
    path = _Path.begin(problem, x)
    lower, upper, best = x[:, problem.dim, 0] + 1, problem.bound(), x
    for iteration in range(MAX_ITERATIONS + 1):
        scale = unit[left]
        undecided = ~settled(lower * scale, upper * scale, left)
        count = int(undecided.sum()) if iteration < MAX_ITERATIONS else 0
        if count <= len(left) // 2:
            # Until then those that are settled go on with the others, but count no more.
            found = found.index_copy(0, left, best)
            largest = largest.index_copy(0, left, lower * scale)
            bound = bound.index_copy(0, left, upper * scale)
            if not count:
                break
            path, left, best = path.select(undecided), left[undecided], best[undecided]
            lower, upper = lower[undecided], upper[undecided]
            undecided = undecided[undecided]
        slack, height = path.slacks()
        least, above, product = path.bounds(slack, height)
        better = undecided & (least > lower)
        best = torch.where(better[:, None, None], path.x, best)
        lower = torch.where(better, least, lower)
        upper = torch.where(undecided & (above < upper), above, upper)
        path.advance(slack, height, product)
    return Best(problem.action(found), largest, bound)


@dataclass(eq=False)
class _Path:
    """Points and weights of B problems on their way.

    Args:
        rows: rows of the program, ``(B, M, n)``.
        offsets: their offsets, ``(B, M, 1)``.
        cones: cones of the program, ``(B, J, 1 + k, n)``.
        tips: their constants, ``(B, J, 1 + k, 1)``.
        spare: 0 for what is on trial and infinite for the others, ``(B, M + J, 1)``.
        low: least values of all unknowns but t, ``(B, n, 1)``.
        high: largest values of all unknowns but t, ``(B, n, 1)``.
        x: unknowns, ``(B, n, 1)``.
        weights: weights of the rows, ``(B, M, 1)``.
        duals: weights of the cones, ``(B, J, 1 + k, 1)``.
        dim: number d of components of an action, after which t stands in x.
    """

    rows: Tensor
    offsets: Tensor
    cones: Tensor
    tips: Tensor
    spare: Tensor
    low: Tensor
    high: Tensor
    x: Tensor
    weights: Tensor
    duals: Tensor
    dim: int

    @classmethod
    def begin(cls, problem: Program, x: Tensor) -> Self:
        """Return the paths from points on, with weights for which the points are best in t."""
        dim, reach = problem.dim, problem.term_reach.unsqueeze(-1)
        one, zero = torch.ones_like(x[:, :dim]), torch.zeros_like(x[:, :1])
        rates = torch.cat([problem.rows[:, :, dim], problem.cones[:, :, 0, dim]], 1).unsqueeze(-1)
        path = cls(
            rows=problem.rows,
            offsets=problem.offsets,
            cones=problem.cones,
            tips=problem.tips,
            spare=torch.zeros_like(rates).masked_fill(rates == 0, torch.inf),
            low=torch.cat([-one, zero, torch.zeros_like(reach)], 1),
            high=torch.cat([one, zero, 2 * reach], 1),
            x=x,
            weights=problem.offsets,
            duals=problem.tips,
            dim=dim,
        )
        slack, height = path.slacks()
        weights, duals = slack.reciprocal(), _flipped(height) / _det(height)
        pull = (torch.cat([weights, duals[:, :, 0]], 1) * rates).sum(1, keepdim=True)
        path.weights, path.duals = weights / pull, duals / pull.unsqueeze(1)
        return path

    def select(self, keep: Tensor) -> Self:
        """Return some of the B paths."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return type(self)(**{n: v if n == "dim" else v[keep] for n, v in values.items()})

    def slacks(self) -> tuple[Tensor, Tensor]:
        """Return the slacks of rows ``(B, M, 1)`` and of cones ``(B, J, 1 + k, 1)``."""
        slack = torch.baddbmm(self.offsets, self.rows, self.x, alpha=-1)
        if not self.cones.shape[1]:
            return slack, self.tips
        return slack, self.tips - self.cones @ self.x.unsqueeze(1)

    def bounds(self, slack: Tensor, height: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return bounds of the best t, ``(B,)`` each, and the weighted sums of all slacks."""
        rooms, pull = slack, self.rows.mT @ self.weights
        product = slack.mT @ self.weights
        if self.cones.shape[1]:
            rooms = torch.cat([slack, height[:, :, 0] - vector_norm(height[:, :, 1:], dim=2)], 1)
            product = product + (height * self.duals).sum((1, 2)).unsqueeze(-1)
            pull = pull + (self.cones.mT @ self.duals).sum(1)
        # What the weighted mean of all slacks may become within the bounds.
        rest = torch.maximum((self.x - self.low) * pull, (self.x - self.high) * pull)
        rest[:, self.dim] = product.squeeze(-1)
        t = self.x[:, self.dim, 0]
        upper = t + (rest.sum(1) / pull[:, self.dim]).squeeze(-1)
        return t + (rooms + self.spare).amin((1, 2)), upper, product

    def advance(self, slack: Tensor, height: Tensor, product: Tensor) -> None:
        """Take a step, from slacks and their weighted sums."""
        count = slack.shape[1]
        root = (self.weights / slack).sqrt()
        scaled, point = self.rows * root, slack * root
        scaling = ConeScaling.between(height, self.duals) if self.cones.shape[1] else None
        if scaling is not None:
            scaled = torch.cat([scaled, scaling.unscaled(self.cones).flatten(1, 2)], 1)
            point = torch.cat([point, scaling.scaled(self.duals).flatten(1, 2)], 1)
        factor = _factor(scaled.mT @ scaled)
        goal = torch.zeros_like(self.x)
        goal[:, self.dim] = 1
        fall = scaled @ torch.cholesky_solve(goal, factor)
        share = 1 / torch.maximum(*self._limits(point, fall, point - fall)).clamp(min=1)
        # The less a step without centering would gain, the more centering there is.
        center = (1 - share) ** 3 * (product / (count + self.cones.shape[1]))
        squared = fall * (fall - point)
        aim = (center + squared[:, :count]) / point[:, :count]
        if scaling is not None:
            own, falls = (v[:, count:].view_as(height) for v in (point, fall))
            wanted = _product(falls, falls - own)
            wanted[:, :, :1] += center.unsqueeze(1)
            aim = torch.cat([aim, _quotient(wanted, own).flatten(1, 2)], 1)
        move = torch.cholesky_solve(torch.baddbmm(goal, scaled.mT, aim, alpha=-1), factor)
        fall = scaled @ move
        loss = point - aim - fall
        limits = self._limits(point, fall, loss)
        if scaling is not None:
            limits = (torch.maximum(*limits),) * 2
        ahead, along = (_FRACTION / limit.clamp(min=_FRACTION) for limit in limits)
        self.x = torch.addcmul(self.x, ahead, move)
        self.weights = torch.addcmul(self.weights, along, root * loss[:, :count], value=-1)
        if scaling is not None:
            change = scaling.unscaled(loss[:, count:].view_as(height))
            self.duals = torch.addcmul(self.duals, along.unsqueeze(1), change, value=-1)

    def _limits(self, point: Tensor, fall: Tensor, loss: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inverse of the largest steps of slacks and weights, ``(B, 1, 1)`` each.

        Args:
            point: slacks, which are as large as the weights, in the scaling of the step.
            fall: what a step takes off the slacks.
            loss: what a step takes off the weights.
        """
        count, changes = self.rows.shape[1], torch.stack([fall, loss])
        limits = (changes[:, :, :count] / point[:, :count]).amax(2, keepdim=True)
        if self.cones.shape[1]:
            changes = changes[:, :, count:].unflatten(2, self.duals.shape[1:3])
            own = point[:, count:].view_as(self.duals)
            # A cone is left where own - step * changes has a determinant of 0, a quadratic.
            det, along = _det(own), _dot(_flipped(own), changes)
            squared = _dot(_flipped(changes), changes)
            steepest = (along + (along.square() - squared * det).relu().sqrt()) / det
            limits = torch.maximum(limits, steepest.amax(2))
        return limits[0], limits[1]


class ConeScaling(NamedTuple):
    r"""The scaling of cones in which a slack s is as large as its weight z.

    :math:`W = \eta\,(2 v v^T - J)` with :math:`W z = W^{-1} s`, and W's root w as its axis.
    """

    head: Tensor
    tail: Tensor
    size: Tensor

    @classmethod
    def between(cls, slack: Tensor, weight: Tensor) -> Self:
        """Return the scaling for slacks and weights ``(B, J, 1 + k, 1)`` inside of the cones."""
        of_slack, of_weight = _det(slack), _det(weight)
        s, z = slack * of_slack.rsqrt(), weight * of_weight.rsqrt()
        axis = (s + _flipped(z)) * (2 + 2 * _dot(s, z)).rsqrt()
        return cls(axis[:, :, :1], axis[:, :, 1:], (of_slack / of_weight) ** 0.25)

    def scaled(self, v: Tensor) -> Tensor:
        """Return W v."""
        first, dot = v[:, :, :1], _dot(self.tail, v[:, :, 1:])
        rest = v[:, :, 1:] + (first + dot / (1 + self.head)) * self.tail
        return self.size * torch.cat([self.head * first + dot, rest], 2)

    def unscaled(self, v: Tensor) -> Tensor:
        """Return the inverse of W times v."""
        first, dot = v[:, :, :1], _dot(self.tail, v[:, :, 1:])
        rest = v[:, :, 1:] + (dot / (1 + self.head) - first) * self.tail
        return torch.cat([self.head * first - dot, rest], 2) / self.size


def _dot(u: Tensor, v: Tensor) -> Tensor:
    return (u * v).sum(-2, keepdim=True)


def _flipped(v: Tensor) -> Tensor:
    """Return vectors ``(..., 1 + k, 1)`` with the sign of all but their first component changed."""
    return torch.cat([v[..., :1, :], -v[..., 1:, :]], -2)


def _det(v: Tensor) -> Tensor:
    """Return the square of the first component less that of the length of the others."""
    length = vector_norm(v[..., 1:, :], dim=-2, keepdim=True)
    return (v[..., :1, :] - length) * (v[..., :1, :] + length)


def _product(u: Tensor, v: Tensor) -> Tensor:
    """Return the Jordan product of vectors of cones."""
    rest = u[:, :, :1] * v[:, :, 1:] + v[:, :, :1] * u[:, :, 1:]
    return torch.cat([_dot(u, v), rest], 2)


def _quotient(u: Tensor, v: Tensor) -> Tensor:
    """Return what gives u when multiplied by v, by the Jordan product."""
    first = _dot(_flipped(v), u) / _det(v)
    return torch.cat([first, (u[:, :, 1:] - first * v[:, :, 1:]) / v[:, :, :1]], 2)


def _factor(hessian: Tensor) -> Tensor:
    """Return the Cholesky factor of matrices that are positive definite but for rounding."""
    factor, failed = torch.linalg.cholesky_ex(hessian)
    if bool(failed.any()):
        # A shift of the size of the rounding gives a direction in which t grows, and where not even
        # that helps, the diagonal does.
        diagonal = torch.diag_embed(hessian.diagonal(dim1=-2, dim2=-1))
        shifted, hopeless = torch.linalg.cholesky_ex(hessian + 1e-9 * diagonal)
        shifted = torch.where((hopeless > 0)[:, None, None], diagonal.sqrt(), shifted)
        factor = torch.where((failed > 0)[:, None, None], shifted, factor)
    return factor
