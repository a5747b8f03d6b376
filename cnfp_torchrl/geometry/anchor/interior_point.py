"""A batched interior-point method for the largest smallest slack of several convex sets.

Path-following with the logarithmic barrier: for growing eta, Newton's method minimizes
``-eta t + barrier(a, t)``. Every iterate is strictly feasible, so its slack is a lower bound of the
best one; a small Newton decrement certifies an upper bound (Nesterov, Introductory Lectures on
Convex Optimization, 2004, theorem 4.2.7).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Self, TypeAlias

import torch
from torch import Tensor

from cnfp_torchrl.geometry.anchor.program import Distances, Point, Program

MAX_ITERATIONS = 150
"""The number of Newton steps after which the best point so far is taken; 15 are usual, 50 rare."""

_GROWTH = 20.0
_TRIALS = 6


class Best(NamedTuple):
    """The best found actions ``(B, d)``, their slacks, and upper bounds of the slack ``(B,)``."""

    action: Tensor
    slack: Tensor
    upper_bound: Tensor


Settled: TypeAlias = Callable[[Tensor, Tensor, Tensor], Tensor]
"""From lower and upper bounds of the best t, and the problems' indices: which need no more work."""


def maximize_slack(problem: Program, start: Tensor, scale: Tensor, settled: Settled) -> Best:
    """Find actions whose smallest slack is large, and certified upper bounds of it.

    Stops for each problem as soon as its bounds say enough: at once where a set is so far from the
    bounds that its Lipschitz slack does, which Newton's method could not tell from rounding error.
    Where rounding error keeps the bounds apart, the best point so far is returned: its slack is
    true, and no more is claimed for the upper bound.

    Args:
        problem: B problems in float64, with rows that bound the actions on all sides.
        start: points strictly inside of the inequalities of rate 0, ``(B, d)``.
        scale: mean widths of the bounds, ``(B,)``.
        settled: function that tells which problems need no more work.
    """
    at = problem.start(start, scale)
    # The bounds' diagonal at most; outside of the bounds nothing is feasible.
    upper_bound = problem.bound_within(start, scale * start.shape[-1])
    found = Best(start.clone(), problem.slack(start), upper_bound)
    # The eta for which the start is best in t.
    eta = _pull_on_slack(problem, at)
    nu = float(problem.barrier_parameter())
    left = torch.arange(len(start), device=start.device)
    lower, upper, action = found.slack, upper_bound, at.action
    for _ in range(MAX_ITERATIONS):
        undecided = ~settled(lower, upper, left)
        if not bool(undecided.all()):
            found = _settle(found, left, lower, upper, action)
            if not bool(undecided.any()):
                return found
            problem, left = problem.select(undecided), left[undecided]
            lower, upper, action = lower[undecided], upper[undecided], action[undecided]
            eta, at = eta[undecided], Point(*(variable[undecided] for variable in at))
        distances = problem.distances(at)
        slack = at.slack + problem.gained(distances)
        action = torch.where((slack > lower).unsqueeze(-1), at.action, action)
        lower = torch.maximum(slack, lower)
        move, squared = newton(problem, at, distances, eta)
        # The absolute value, because a negative one is all rounding error.
        decrement = squared.abs().sqrt()
        near = decrement < 0.5
        gap = (nu + (decrement + nu**0.5) * decrement / (1 - decrement)) / eta
        upper = torch.minimum(upper, torch.where(near, at.slack + gap, torch.inf))
        at = _line_search(problem, at, move, eta, decrement)
        eta = torch.where(near, eta * _GROWTH, eta)
    return _settle(found, left, lower, upper, action)


def _settle(found: Best, index: Tensor, lower: Tensor, upper: Tensor, action: Tensor) -> Best:
    """Return what was found with the bounds and actions of some of the problems."""
    return Best(
        found.action.index_copy(0, index, action),
        found.slack.index_copy(0, index, lower),
        found.upper_bound.index_copy(0, index, upper),
    )


def newton(problem: Program, at: Point, distances: Distances, eta: Tensor) -> tuple[Point, Tensor]:
    """Return the Newton direction of ``-eta t + barrier`` and its squared decrement ``(B,)``.

    Args:
        problem: B problems.
        at: strictly feasible points.
        distances: distances of these points from the inequalities.
        eta: weights of t, ``(B,)``.
    """
    inverse = distances.rows.reciprocal().unsqueeze(-1)
    rows = torch.cat([problem.rows, problem.row_rates.unsqueeze(-1)], -1) * inverse
    gradient, hessian = rows.sum(-2), rows.mT @ rows
    gradient[:, -1] -= eta
    if problem.has_cones:
        _add_cones(problem, at, distances, gradient, hessian)
    if not problem.has_sums:
        move = -_solve(hessian, gradient)
        return Point(move[:, :-1], move[:, -1], at.terms), -(gradient * move).sum(-1)
    sums = _KinkedSums.at(problem, distances)
    own, eliminated = sums.gradients()
    hessian = hessian + sums.reduced_hessian()
    move = -_solve(hessian, gradient + own - eliminated)
    terms = sums.move_of_terms(move)
    decrement = -((gradient + own) * move).sum(-1) - (sums.gradient * terms).sum((-2, -1))
    return Point(move[:, :-1], move[:, -1], terms), decrement


def _add_cones(
    problem: Program, at: Point, s: Distances, gradient: Tensor, hessian: Tensor
) -> None:
    """Add the barriers of cones, ``-log(h^2 - |y|^2)``, to gradient and Hessian in (action, t)."""
    white = problem.white(at.action)
    height = problem.cone_sizes - problem.cone_rates * at.slack.unsqueeze(-1)
    inverse = 2 / (s.cone_gaps * s.cone_sums)
    # Half of the gradient times h^2 - |y|^2.
    pulled = (problem.matrices * white.unsqueeze(-1)).sum(-2)
    z = torch.cat([pulled, (height * problem.cone_rates).unsqueeze(-1)], -1)
    z = z * inverse.unsqueeze(-1)
    gradient += z.sum(-2)
    hessian += z.mT @ z
    matrices = (problem.matrices * inverse.sqrt()[..., None, None]).flatten(1, 2)
    hessian[:, :-1, :-1] += matrices.mT @ matrices
    hessian[:, -1, -1] -= (inverse * problem.cone_rates.square()).sum(-1)


class _KinkedSums(NamedTuple):
    """Barriers of kinked sums, whose terms' bounds u are eliminated: diagonal plus rank one.

    The Hessian in u is ``diag(curvature) + r^2 1 1^T``, that of u and the action ``-diag(pull)``,
    that of u and the slack ``r^2 rates``.
    """

    problem: Program
    p: Tensor
    q: Tensor
    r: Tensor
    curvature: Tensor
    pull: Tensor
    gradient: Tensor
    kappa: Tensor

    @classmethod
    def at(cls, problem: Program, s: Distances) -> Self:
        p, q, r = s.upper.reciprocal(), s.lower.reciprocal(), s.sums.reciprocal()
        curvature = p.square() + q.square()
        kappa = r.square() / (1 + r.square() * curvature.reciprocal().sum(-1))
        pull = problem.upper * p.square() + problem.lower * q.square()
        return cls(problem, p, q, r, curvature, pull, r.unsqueeze(-1) - p - q, kappa)

    def solve(self, right: Tensor) -> Tensor:
        """Solve with the Hessian in u, by Sherman and Morrison."""
        scaled = right / self.curvature
        return scaled - (self.kappa * scaled.sum(-1)).unsqueeze(-1) / self.curvature

    def gradients(self) -> tuple[Tensor, Tensor]:
        """Return the gradient in (action, slack), and what elimination takes off it."""
        upper, lower, rates = self.problem.upper, self.problem.lower, self.problem.sum_rates
        own = _joined((upper * self.p + lower * self.q).sum(-2), (rates * self.r).sum(-1))
        relaxed = self.solve(self.gradient)
        slack = (rates * self.r.square() * relaxed.sum(-1)).sum(-1)
        return own, _joined(-(self.pull * relaxed).sum(-2), slack)

    def reduced_hessian(self) -> Tensor:
        """Return the Schur complement in (action, slack)."""
        spread = self.p * self.q * (self.problem.upper - self.problem.lower)
        row = _joined(self.pull / self.curvature, self.problem.sum_rates)
        diagonal = (spread.square() / self.curvature).sum(-2)
        diagonal = _joined(diagonal, torch.zeros_like(diagonal[:, 0]))
        return torch.diag_embed(diagonal) + (row * self.kappa.unsqueeze(-1)).mT @ row

    def move_of_terms(self, move: Tensor) -> Tensor:
        """Return the Newton direction of u that goes with one of (action, slack)."""
        slack = self.problem.sum_rates * self.r.square() * move[:, -1:]
        pulled = self.pull * move[:, None, :-1] - slack.unsqueeze(-1)
        return self.solve(pulled - self.gradient)


def _joined(action: Tensor, slack: Tensor) -> Tensor:
    return torch.cat([action, slack.unsqueeze(-1)], -1)


def _pull_on_slack(problem: Program, at: Point) -> Tensor:
    s = problem.distances(at)
    pull = (problem.row_rates / s.rows).sum(-1)
    if problem.has_cones:
        height = problem.cone_sizes - problem.cone_rates * at.slack.unsqueeze(-1)
        pull = pull + (2 * height * problem.cone_rates / (s.cone_gaps * s.cone_sums)).sum(-1)
    if problem.has_sums:
        pull = pull + (problem.sum_rates / s.sums).sum(-1)
    return pull


def _line_search(problem: Program, at: Point, move: Point, eta: Tensor, decrement: Tensor) -> Point:
    """Take the best step between the damped Newton step, which always helps, and a full one."""
    share = torch.linspace(1, 0, _TRIALS, dtype=eta.dtype, device=eta.device).unsqueeze(-1)
    steps = (1 + decrement) ** -share
    trials = at.moved(move, steps)
    value = problem.barrier(problem.distances(trials)) - eta * (steps * move.slack)
    best = steps.gather(0, value.argmin(0, keepdim=True)).squeeze(0)
    return at.moved(move, best)


def _solve(hessian: Tensor, right: Tensor) -> Tensor:
    """Solve with a positive definite matrix, scaled to a unit diagonal."""
    scale = hessian.diagonal(dim1=-2, dim2=-1).rsqrt()
    scaled = hessian * scale.unsqueeze(-1) * scale.unsqueeze(-2)
    factor, failed = torch.linalg.cholesky_ex(scaled)
    if bool(failed.any()):
        # Rounding made a matrix indefinite; a shift of that size gives a descent direction, and
        # where not even that helps, the diagonal does.
        identity = torch.eye(hessian.shape[-1], dtype=hessian.dtype, device=hessian.device)
        shifted, hopeless = torch.linalg.cholesky_ex(scaled + 1e-9 * identity)
        shifted = torch.where((hopeless > 0)[:, None, None], identity, shifted)
        factor = torch.where((failed > 0)[:, None, None], shifted, factor)
    right = (right * scale).unsqueeze(-1)
    return (torch.cholesky_solve(right, factor).squeeze(-1) * scale).nan_to_num()
