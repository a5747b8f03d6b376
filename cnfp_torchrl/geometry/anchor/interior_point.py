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
from dataclasses import dataclass
from typing import NamedTuple, Self, TypeAlias

import numpy as np

from cnfp_torchrl.geometry.anchor.program import (
    START,
    Array,
    Flags,
    Index,
    Program,
    length,
    times,
)

MAX_ITERATIONS = 60
"""The number of steps after which the best point so far is taken; 6 are usual, 20 rare."""

_LARGEST = 3.0
"""The largest weight at the start of what is not maximized, where what is has one of 1 at most."""

_FRACTION = 0.98
"""The share of the way to the boundary that a step may go."""

_FEW = 8
"""The number of problems up to which it takes no longer to go on with all than with some."""


class Best(NamedTuple):
    """The best found actions, and what certifies that there are none much better.

    Attributes:
        action: Actions, ``(B, d)``.
        slack: Their slacks, ``(B,)``.
        upper_bound: Upper bounds of the slack, ``(B,)``.
        weights: Weights of sums, rows and cones in these bounds, in sum 1 for the maximized
            ones, NaN where no weights were needed, ``(R, B)``; None where they are not known.
    """

    action: Array
    slack: Array
    upper_bound: Array
    weights: Array | None = None


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
        start: Points strictly inside of what is not maximized, ``(B, d)``.
        settled: The function that tells which problems need no more work.
    """
    # Some of the problems that go on after they are settled may end in infinities.
    with np.errstate(all="ignore"):
        x = problem.start(start)
        found, largest, bound = x.copy(), np.empty(len(start)), np.empty(len(start))
        left = np.arange(len(start))
        path = _Path.begin(problem, x)
        lower, upper, best = x[problem.dim] + START, problem.bound(), x.copy()
        proof = np.zeros_like(path.rates)
        weights = np.zeros((len(problem.rows) + len(problem.cones), len(start)))
        undecided = np.ones(len(start), dtype=bool)
        for iteration in range(MAX_ITERATIONS + 1):
            least, above = path.bounds()
            better, nearer = undecided & (least > lower), undecided & (above < upper)
            np.copyto(best, path.x, where=better)
            np.copyto(lower, least, where=better)
            np.copyto(upper, above, where=nearer)
            np.copyto(proof, path.proof(), where=nearer)
            scale = problem.unit[left]
            undecided = ~settled(lower * scale, upper * scale, left)
            # Beyond rounding error a path may end in NaN, from where no step leads on.
            undecided &= np.isfinite(path.x[problem.dim])
            count = int(undecided.sum()) if iteration < MAX_ITERATIONS else 0
            if not count or 2 * count <= len(left) > _FEW:
                # Until then those that are settled go on with the others, but count no more.
                found[:, left], largest[left], bound[left] = best, lower * scale, upper * scale
                weights[np.ix_(path.which, left)] = proof / (proof * path.rates).sum(0)
                if not count:
                    break
                path, left, best = path.select(undecided), left[undecided], best[:, undecided]
                lower, upper, proof = lower[undecided], upper[undecided], proof[:, undecided]
                undecided = undecided[undecided]
            path.advance()
        return Best(problem.action(found), largest, bound, weights[2 * len(problem.reach) :])


@dataclass(eq=False)
class _Path:
    """Points and weights of B problems on their way.

    Args:
        rows: Rows of the program, ``(M, n, B)``.
        offsets: Their offsets, ``(M, B)``.
        cones: Cones of the program, ``(J, 1 + k, n, B)``.
        tips: Their constants, ``(J, 1 + k, B)``.
        rates: 1 for maximized rows and cones and 0 for the others, ``(M + J, B)``.
        spare: 0 for what is maximized and infinite for the others, ``(M + J, B)``.
        low: Least values of all unknowns but t, ``(n, B)``.
        high: Largest values of all unknowns but t, ``(n, B)``.
        x: Unknowns, ``(n, B)``.
        weights: Weights of the rows, ``(M, B)``.
        duals: Weights of the cones, ``(J, 1 + k, B)``.
        dim: The number d of components of an action, after which t stands in x.
        which: Indices of the rows and cones among the program's, ``(M + J,)``.
        slack: Slacks of the rows at x, ``(M, B)``.
        height: Slacks of the cones at x, ``(J, 1 + k, B)``.
        product: The weighted sums of all slacks, once bounds are known, ``(B,)``.
    """

    rows: Array
    offsets: Array
    cones: Array
    tips: Array
    rates: Array
    spare: Array
    low: Array
    high: Array
    x: Array
    weights: Array
    duals: Array
    dim: int
    which: Index
    slack: Array
    height: Array
    product: Array

    @classmethod
    def begin(cls, problem: Program, x: Array) -> Self:
        """Return the paths from points on, with weights for which these are about the best."""
        dim = problem.dim
        # Cones take most of the time, so that those that count nowhere are left out.
        counts = problem.cones.any((1, 2, 3))
        cones, tips = problem.cones[counts], problem.tips[counts]
        rates = np.concatenate([problem.rows[:, dim], cones[:, 0, dim]])
        low, high = np.zeros_like(x), np.ones_like(x)
        low[:dim], high[dim + 1 :] = -1, problem.reach
        path = cls(
            rows=problem.rows,
            offsets=problem.offsets,
            cones=cones,
            tips=tips,
            rates=rates,
            spare=np.where(rates > 0, 0.0, np.inf),
            low=low,
            high=high,
            x=x,
            weights=problem.offsets,
            duals=tips,
            dim=dim,
            which=np.concatenate([np.ones(len(problem.rows), dtype=bool), counts]).nonzero()[0],
            slack=problem.offsets,
            height=tips,
            product=problem.unit,
        )
        path.move(x)
        weights, duals = 1 / path.slack, _flipped(path.height) / _det(path.height)[:, None]
        pull = (np.concatenate([weights, duals[:, 0]]) * rates).sum(0)
        # What is not maximized may be nearly touched, yet matter little in the end.
        most = np.where(rates > 0, np.inf, _LARGEST)
        most[: 2 * len(problem.reach)] = np.inf  # the terms of sums belong to these
        weights = np.minimum(weights, most[: len(weights)])
        excess = np.maximum(duals[:, 0] / most[len(weights) :], 1)
        path.weights, path.duals = weights / pull, duals / (excess[:, None] * pull)
        return path

    def select(self, keep: Flags) -> Self:
        """Return some of the B paths."""
        values, same = vars(self).items(), ("dim", "which")
        return type(self)(**{n: v if n in same else v[..., keep] for n, v in values})

    def move(self, x: Array) -> None:
        """Go to points."""
        self.x, self.slack = x, self.offsets - times(self.rows, x)
        if len(self.cones):
            self.height = self.tips - times(self.cones, x)

    def bounds(self) -> tuple[Array, Array]:
        """Return the largest t at the points, and upper bounds of the best one, ``(B,)`` each."""
        rooms, pull = self.slack, _pulled(self.rows, self.weights)
        self.product = (self.slack * self.weights).sum(0)
        if len(self.cones):
            size = length(self.height[:, 1:])
            rooms = np.concatenate([rooms, self.height[:, 0] - size])
            self.product += (self.height * self.duals).sum((0, 1))
            pull += _pulled(_side_by_side(self.cones), _side_by_side(self.duals))
        # What the weighted mean of all slacks may become within the bounds.
        rest = np.maximum((self.x - self.low) * pull, (self.x - self.high) * pull)
        rest[self.dim] = self.product
        t = self.x[self.dim]
        return t + (rooms + self.spare).min(0), t + rest.sum(0) / pull[self.dim]

    def proof(self) -> Array:
        """Return the weights of rows and cones in the upper bounds, ``(M + J, B)``."""
        return np.concatenate([self.weights, self.duals[:, 0]])

    def advance(self) -> None:
        """Take a step.

        For rows all is relative to their slacks and weights, for cones in a scaling in which the
        two are the same vector.
        """
        slack, count, cones = self.slack, len(self.slack), len(self.cones)
        left, right = self.rows * (self.weights / slack)[:, None], self.rows
        if cones:
            scaling = ConeScaling.between(self.height, self.duals)
            scaled = _side_by_side(scaling.unscaled(self.cones))
            point = scaling.scaled(self.duals)
            mirror = _flipped(point)
            left, right = np.concatenate([left, scaled]), np.concatenate([right, scaled])
        matrix = left.transpose(2, 1, 0) @ right.transpose(2, 0, 1)
        # Rounding may have made a matrix singular.
        np.einsum("bii->bi", matrix)[...] *= 1 + 1e-14
        # First a step without centering: the less it would gain, the more centering there is.
        pull = np.zeros_like(self.x)
        pull[self.dim] = 1
        move = _solved(matrix, pull)
        fall = times(self.rows, move) / slack
        limit = np.maximum(fall.max(0), 1 - fall.min(0))
        if cones:
            falls = times(scaled, move).reshape(point.shape)
            along, root = _crossing(mirror, scaling.det, falls)
            # Weights fall by what is left of the slacks: they cross at the other root.
            steepest = (np.maximum(along, scaling.det - along) + root) / scaling.det
            limit = np.maximum(limit, steepest.max(0))
        far = 1 - 1 / np.maximum(limit, 1)
        center = far * far * far * self.product / (count + cones)
        aim = center / (slack * self.weights) + fall * (fall - 1)
        pull -= _pulled(self.rows, self.weights * aim)
        if cones:
            wanted = _product(falls, falls - point)
            wanted[:, 0] += center
            aims = _quotient(wanted, point, mirror, scaling.det)
            pull -= _pulled(scaled, _side_by_side(aims))
        move = _solved(matrix, pull)
        fall = times(self.rows, move) / slack
        loss = 1 - aim - fall
        ahead, along = fall.max(0), loss.max(0)
        if cones:
            falls = times(scaled, move).reshape(point.shape)
            losses = point - aims - falls
            crossing = _crossing(mirror, scaling.det, np.stack([falls, losses]))
            limits = (sum(crossing) / scaling.det).max((0, 1))
            # Steps of two lengths may go round in circles, without end.
            ahead = along = np.maximum(limits, np.maximum(ahead, along))
        ahead, along = (_FRACTION / np.maximum(limit, _FRACTION) for limit in (ahead, along))
        self.weights = self.weights * (1 - along * loss)
        if cones:
            self.duals = self.duals - along * scaling.unscaled(losses)
        self.move(self.x + ahead * move)


def _crossing(mirror: Array, det: Array, change: Array) -> tuple[Array, Array]:
    """Return two terms whose sum, divided by det, is the inverse of the largest step in cones.

    Args:
        mirror: Points in the cones, flipped, ``(J, 1 + k, B)``.
        det: Their determinants, ``(J, B)``.
        change: What a step takes off the points, ``(..., J, 1 + k, B)``.
    """
    # A cone is left where point - step * change has a determinant of 0, a quadratic.
    along = (mirror * change).sum(-2)
    squared = 2 * np.square(change[..., 0, :]) - np.square(change).sum(-2)
    return along, np.sqrt(np.maximum(along * along - squared * det, 0))


class ConeScaling(NamedTuple):
    r"""The symmetric scaling W of cones with :math:`W z = W^{-1} s` for slacks s and weights z.

    Args:
        head: The first components of the axes, which are of determinant 1, ``(J, B)``.
        tail: Other components of the axes, ``(J, k, B)``.
        size: Sizes ``(J, B)``.
        det: Determinants of the vectors that slacks and weights become, ``(J, B)``.
    """

    head: Array
    tail: Array
    size: Array
    det: Array

    @classmethod
    def between(cls, slack: Array, weight: Array) -> Self:
        """Return the scaling for slacks and weights ``(J, 1 + k, B)`` inside of the cones."""
        of_slack, of_weight = (np.sqrt(_det(v)) for v in (slack, weight))
        s, z = slack / of_slack[:, None], weight / of_weight[:, None]
        axis = (s + _flipped(z)) / np.sqrt(2 + 2 * (s * z).sum(1))[:, None]
        return cls(axis[:, 0], axis[:, 1:], np.sqrt(of_slack / of_weight), of_slack * of_weight)

    def scaled(self, v: Array) -> Array:
        """Return W v, of vectors ``(J, 1 + k, B)``."""
        dot = (self.tail * v[:, 1:]).sum(1)
        result = np.empty_like(v)
        result[:, 0] = self.head * v[:, 0] + dot
        result[:, 1:] = v[:, 1:] + (v[:, 0] + dot / (1 + self.head))[:, None] * self.tail
        return result * self.size[:, None]

    def unscaled(self, v: Array) -> Array:
        """Return the inverse of W times v, of vectors ``(J, 1 + k, B)`` or ``(J, 1 + k, n, B)``."""
        head, tail, size, _ = self
        if v.ndim == 4:
            head, tail, size = head[:, None], tail[:, :, None], size[:, None]
        dot = (tail * v[:, 1:]).sum(1)
        result = np.empty_like(v)
        result[:, 0] = head * v[:, 0] - dot
        result[:, 1:] = v[:, 1:] + (dot / (1 + head) - v[:, 0])[:, None] * tail
        return result / size[:, None]


def _solved(matrix: Array, wanted: Array) -> Array:
    """Return solutions ``(n, B)`` with matrices ``(B, n, n)``, NaN where one is singular."""
    # Not by inverses, whose rounding error would keep bounds apart.
    try:
        return np.ascontiguousarray(np.linalg.solve(matrix, wanted.T[..., None])[..., 0].T)
    except np.linalg.LinAlgError:
        if len(matrix) == 1:
            return np.full_like(wanted, np.nan)
    each = (_solved(matrix[i : i + 1], wanted[:, i : i + 1]) for i in range(len(matrix)))
    return np.concatenate(list(each), -1)


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


def _quotient(u: Array, v: Array, mirror: Array, det: Array) -> Array:
    """Return what gives u when multiplied by v, of which more is known, by the Jordan product."""
    first = ((mirror * u).sum(1) / det)[:, None]
    result = (u - first * v) / v[:, :1]
    result[:, :1] = first
    return result
