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

import numpy as np

from cnfp_torchrl.geometry.anchor.program import Array, Flags, Index, Program, length, times

MAX_ITERATIONS = 60
"""The number of steps after which the best point so far is taken; 6 are usual, 20 rare."""

_FRACTION = 0.995
"""The share of the way to the boundary that a step may go."""

_SMALL = 8
"""The largest number of unknowns for which elimination side by side is the fastest."""


class Best(NamedTuple):
    """The best found actions ``(B, d)``, their slacks, and upper bounds of the slack ``(B,)``."""

    action: Array
    slack: Array
    upper_bound: Array


Settled: TypeAlias = Callable[[Array, Array, Index], Flags]
"""From lower and upper bounds of the best t, and the problems' indices: which need no more work."""


def maximize_slack(problem: Program, start: Array, settled: Settled) -> Best:
    """Find actions whose smallest slack is large, and certified upper bounds of it.

    Stops for each problem as soon as its bounds say enough: at once where a set is so far from the
    bounds that the largest slack within them does, which Newton's method could not tell from
    rounding error. Where rounding error keeps the bounds apart, the best point so far is returned:
    its slack is true, and no more is claimed for the upper bound.

    Args:
        problem: B problems, with rows that bound the actions on all sides.
        start: points strictly inside of what is not on trial, ``(B, d)``.
        settled: function that tells which problems need no more work.
    """
    # Some of the problems that go on after they are settled may end in infinities.
    with np.errstate(all="ignore"):
        x = problem.start(start)
        found, largest, bound = x.copy(), np.empty(len(start)), np.empty(len(start))
        left = np.arange(len(start))
        path = _Path.begin(problem, x)
        lower, upper, best = x[problem.dim] + 1, problem.bound(), x
        for iteration in range(MAX_ITERATIONS + 1):
            scale = problem.unit[left]
            undecided = ~settled(lower * scale, upper * scale, left)
            count = int(undecided.sum()) if iteration < MAX_ITERATIONS else 0
            if count <= len(left) // 2:
                # Until then those that are settled go on with the others, but count no more.
                found[:, left], largest[left], bound[left] = best, lower * scale, upper * scale
                if not count:
                    break
                path, left, best = path.select(undecided), left[undecided], best[:, undecided]
                lower, upper = lower[undecided], upper[undecided]
                undecided = undecided[undecided]
            slack, height = path.slacks()
            least, above, product = path.bounds(slack, height)
            better = undecided & (least > lower)
            best = np.where(better, path.x, best)
            lower = np.where(better, least, lower)
            upper = np.where(undecided & (above < upper), above, upper)
            path.advance(slack, height, product)
        return Best(problem.action(found), largest, bound)


@dataclass(eq=False)
class _Path:
    """Points and weights of B problems on their way.

    Args:
        rows: rows of the program, ``(M, n, B)``.
        offsets: their offsets, ``(M, B)``.
        cones: cones of the program, ``(J, 1 + k, n, B)``.
        tips: their constants, ``(J, 1 + k, B)``.
        spare: 0 for what is on trial and infinite for the others, ``(M + J, B)``.
        low: least values of all unknowns but t, ``(n, B)``.
        high: largest values of all unknowns but t, ``(n, B)``.
        x: unknowns, ``(n, B)``.
        weights: weights of the rows, ``(M, B)``.
        duals: weights of the cones, ``(J, 1 + k, B)``.
        dim: number d of components of an action, after which t stands in x.
    """

    rows: Array
    offsets: Array
    cones: Array
    tips: Array
    spare: Array
    low: Array
    high: Array
    x: Array
    weights: Array
    duals: Array
    dim: int

    @classmethod
    def begin(cls, problem: Program, x: Array) -> Self:
        """Return the paths from points on, with weights for which the points are best in t."""
        dim = problem.dim
        rates = np.concatenate([problem.rows[:, dim], problem.cones[:, 0, dim]])
        low, high = np.zeros_like(x), np.ones_like(x)
        low[:dim], high[dim + 1 :] = -1, problem.reach
        path = cls(
            rows=problem.rows,
            offsets=problem.offsets,
            cones=problem.cones,
            tips=problem.tips,
            spare=np.where(rates > 0, 0.0, np.inf),
            low=low,
            high=high,
            x=x,
            weights=problem.offsets,
            duals=problem.tips,
            dim=dim,
        )
        slack, height = path.slacks()
        weights, duals = 1 / slack, _flipped(height) / _det(height)[:, None]
        pull = (np.concatenate([weights, duals[:, 0]]) * rates).sum(0)
        path.weights, path.duals = weights / pull, duals / pull
        return path

    def select(self, keep: Flags) -> Self:
        """Return some of the B paths."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return type(self)(**{n: v if n == "dim" else v[..., keep] for n, v in values.items()})

    def slacks(self) -> tuple[Array, Array]:
        """Return the slacks of rows ``(M, B)`` and of cones ``(J, 1 + k, B)``."""
        slack = self.offsets - times(self.rows, self.x)
        return slack, self.tips - times(self.cones, self.x) if len(self.cones) else self.tips

    def bounds(self, slack: Array, height: Array) -> tuple[Array, Array, Array]:
        """Return bounds of the best t, and the weighted sums of all slacks, ``(B,)`` each."""
        rooms, pull = slack, _pulled(self.rows, self.weights)
        product = (slack * self.weights).sum(0)
        if len(self.cones):
            rooms = np.concatenate([slack, height[:, 0] - length(height[:, 1:])])
            product = product + (height * self.duals).sum((0, 1))
            pull = pull + _pulled(_side_by_side(self.cones), _side_by_side(self.duals))
        # What the weighted mean of all slacks may become within the bounds.
        rest = np.maximum((self.x - self.low) * pull, (self.x - self.high) * pull)
        rest[self.dim] = product
        t = self.x[self.dim]
        return t + (rooms + self.spare).min(0), t + rest.sum(0) / pull[self.dim], product

    def advance(self, slack: Array, height: Array, product: Array) -> None:
        """Take a step, from slacks and their weighted sums."""
        count = len(slack)
        root = np.sqrt(self.weights / slack)
        scaled, point = self.rows * root[:, None], slack * root
        scaling = ConeScaling.between(height, self.duals) if len(self.cones) else None
        if scaling is not None:
            cones = [scaling.unscaled(self.cones), scaling.scaled(self.duals)]
            scaled = np.concatenate([scaled, _side_by_side(cones[0])])
            point = np.concatenate([point, _side_by_side(cones[1])])
        matrix = _Normal.of(scaled)
        goal = np.zeros_like(self.x)
        goal[self.dim] = 1
        fall = times(scaled, matrix.solve(goal))
        share = 1 / np.maximum(self._limits(point, np.stack([fall, point - fall])).max(0), 1)
        # The less a step without centering would gain, the more centering there is.
        center = (1 - share) ** 3 * (product / (count + len(self.cones)))
        aim = (center + (fall * (fall - point))[:count]) / point[:count]
        if scaling is not None:
            own, falls = (v[count:].reshape(height.shape) for v in (point, fall))
            wanted = _product(falls, falls - own)
            wanted[:, 0] += center
            aim = np.concatenate([aim, _side_by_side(_quotient(wanted, own))])
        move = matrix.solve(goal - _pulled(scaled, aim))
        fall = times(scaled, move)
        loss = point - aim - fall
        limits = self._limits(point, np.stack([fall, loss]))
        if scaling is not None:
            limits[:] = limits.max(0)
        ahead, along = _FRACTION / np.maximum(limits, _FRACTION)
        self.x = self.x + ahead * move
        self.weights = self.weights - along * (root * loss[:count])
        if scaling is not None:
            change = scaling.unscaled(loss[count:].reshape(height.shape))
            self.duals = self.duals - along * change

    def _limits(self, point: Array, changes: Array) -> Array:
        """Return the inverse of the largest steps of slacks and weights, ``(2, B)``.

        Args:
            point: slacks, which are as large as the weights, in the scaling of the step.
            changes: what a step takes off the slacks and off the weights.
        """
        count = len(self.rows)
        limits = (changes[:, :count] / point[:count]).max(1)
        if len(self.cones):
            own = point[count:].reshape(self.duals.shape)
            falls = changes[:, count:].reshape(2, *self.duals.shape)
            # A cone is left where own - step * falls has a determinant of 0, a quadratic.
            det, along = _det(own), (_flipped(own) * falls).sum(2)
            squared = np.square(falls[:, :, 0]) - np.square(falls[:, :, 1:]).sum(2)
            steepest = (along + np.sqrt(np.maximum(along * along - squared * det, 0))) / det
            limits = np.maximum(limits, steepest.max(1))
        return limits


class ConeScaling(NamedTuple):
    r"""The symmetric scaling W of cones with :math:`W z = W^{-1} s` for slacks s and weights z.

    Args:
        head: first components of the axes, which are of determinant 1, ``(J, B)``.
        tail: other components of the axes, ``(J, k, B)``.
        size: sizes ``(J, B)``.
    """

    head: Array
    tail: Array
    size: Array

    @classmethod
    def between(cls, slack: Array, weight: Array) -> Self:
        """Return the scaling for slacks and weights ``(J, 1 + k, B)`` inside of the cones."""
        of_slack, of_weight = _det(slack), _det(weight)
        s, z = slack / np.sqrt(of_slack)[:, None], weight / np.sqrt(of_weight)[:, None]
        axis = (s + _flipped(z)) / np.sqrt(2 + 2 * (s * z).sum(1))[:, None]
        return cls(axis[:, 0], axis[:, 1:], np.sqrt(np.sqrt(of_slack / of_weight)))

    def scaled(self, v: Array) -> Array:
        """Return W v, of vectors ``(J, 1 + k, B)``."""
        dot = (self.tail * v[:, 1:]).sum(1)
        result = np.empty_like(v)
        result[:, 0] = self.head * v[:, 0] + dot
        result[:, 1:] = v[:, 1:] + (v[:, 0] + dot / (1 + self.head))[:, None] * self.tail
        return result * self.size[:, None]

    def unscaled(self, v: Array) -> Array:
        """Return the inverse of W times v, of vectors ``(J, 1 + k, B)`` or ``(J, 1 + k, n, B)``."""
        head, tail, size = self
        if v.ndim == 4:
            head, tail, size = head[:, None], tail[:, :, None], size[:, None]
        dot = (tail * v[:, 1:]).sum(1)
        result = np.empty_like(v)
        result[:, 0] = head * v[:, 0] - dot
        result[:, 1:] = v[:, 1:] + (dot / (1 + head) - v[:, 0])[:, None] * tail
        return result / size[:, None]


class _Normal(NamedTuple):
    """Matrices ``S^T S``, inverted where they are small: what that costs in accuracy is one step's.

    Args:
        matrix: matrices ``(B, n, n)``, or their inverses ``(n, n, B)``.
        inverted: whether they are inverses.
    """

    matrix: Array
    inverted: bool

    @classmethod
    def of(cls, scaled: Array) -> Self:
        """Return the matrices for S, ``(m, n, B)``."""
        each = np.arange(scaled.shape[1])
        if len(each) > _SMALL:
            first = np.ascontiguousarray(scaled.transpose(2, 0, 1))
            matrix = first.transpose(0, 2, 1) @ first
            # Rounding may have made a matrix singular.
            matrix[:, each, each] *= 1 + 1e-14
            # Of problems that went on after they were settled, which no longer count.
            matrix[~np.isfinite(matrix).all((1, 2))] = np.eye(len(each))
            return cls(matrix, inverted=False)
        inverse = np.einsum("mib,mjb->ijb", scaled, scaled)
        least = 1e-15 * inverse[each, each]
        for k in each:
            # Where rounding made a matrix indefinite, t still grows along the direction.
            pivot = np.maximum(inverse[k, k], least[k])
            column, row = inverse[:, k] / pivot, inverse[k].copy()
            inverse -= column[:, None] * row
            inverse[k] = row / pivot
            inverse[:, k] = -column
            inverse[k, k] = 1 / pivot
        return cls(inverse, inverted=True)

    def solve(self, right: Array) -> Array:
        """Return the solutions for right-hand sides ``(n, B)``."""
        if self.inverted:
            return times(self.matrix, right)
        solution = np.linalg.solve(self.matrix, right.T[..., None])
        return np.asarray(solution[..., 0].T, dtype=np.float64)


def _pulled(matrix: Array, weights: Array) -> Array:
    """Return the product of transposed matrices ``(m, n, B)`` with vectors ``(m, B)``."""
    return np.asarray(np.einsum("mib,mb->ib", matrix, weights), dtype=np.float64)


def _side_by_side(v: Array) -> Array:
    """Return vectors or matrices ``(J, 1 + k, ...)`` of all cones as ``(J (1 + k), ...)``."""
    return v.reshape(-1, *v.shape[2:])


def _flipped(v: Array) -> Array:
    """Return vectors ``(J, 1 + k, B)`` with the sign of all but their first component changed."""
    result = -v
    result[:, 0] = v[:, 0]
    return result


def _det(v: Array) -> Array:
    """Return the square of the first component less that of the length of the others."""
    size = length(v[:, 1:])
    return (v[:, 0] - size) * (v[:, 0] + size)


def _product(u: Array, v: Array) -> Array:
    """Return the Jordan product of vectors of cones."""
    result = u[:, :1] * v + v[:, :1] * u
    result[:, 0] = (u * v).sum(1)
    return result


def _quotient(u: Array, v: Array) -> Array:
    """Return what gives u when multiplied by v, by the Jordan product."""
    first = ((_flipped(v) * u).sum(1) / _det(v))[:, None]
    result = (u - first * v) / v[:, :1]
    result[:, :1] = first
    return result
