"""A batched interior-point method for the largest smallest slack of several convex sets.

Path-following with the logarithmic barrier: for growing eta, Newton's method minimizes
``-eta t + barrier(a, t)``. Every iterate is strictly feasible, so its slack is a lower bound of the
best one; a small Newton decrement certifies an upper bound (Nesterov, Introductory Lectures on
Convex Optimization, 2004, theorem 4.2.7).
"""

from __future__ import annotations

from typing import NamedTuple, Self

import torch
from torch import Tensor

from cnfp_torchrl.geometry.slack_program import Distances, Point, Program, weigh

MAX_ITERATIONS = 1000
"""Newton steps before the method gives up with an error; some 20 are usual, 100 rare."""

RELATIVE_GAP = 1e-9
"""How close bounds of the best slack come, relative to the scale, before they count as equal."""

_GROWTH = 5.0
_TRIALS = 8


class Best(NamedTuple):
    """The best found actions ``(B, d)``, their slacks, and upper bounds of the slack ``(B,)``."""

    action: Tensor
    slack: Tensor
    upper_bound: Tensor


def maximize_slack(
    problem: Program, start: Tensor, scale: Tensor, enough: float, share: float
) -> Best:
    """Find actions whose smallest slack is large, and certified upper bounds of it.

    Stops for each problem as soon as the slack is at least `enough` and a share of the upper bound,
    or the upper bound is below `enough`: at once where a set is so far from the bounds that its
    Lipschitz slack says so, which Newton's method could not tell from rounding error.

    Args:
        problem: B problems in float64, with rows that bound the actions on all sides.
        start: the middles of these bounds, ``(B, d)``.
        scale: the mean widths of these bounds, ``(B,)``.
        enough: the smallest slack of interest.
        share: the share of the best slack that will do, below 1.

    Raises:
        RuntimeError: when a problem is undecided after `MAX_ITERATIONS`.
    """
    at = problem.start(start, scale)
    # Half of the bounds' diagonal at most; outside of the bounds the slack is negative.
    reach = scale * start.shape[-1] / 2
    upper_bound = problem.bound_within(start, reach).clamp(min=0)
    found = Best(start.clone(), problem.slack(start), upper_bound)
    # The eta for which the start is best in t.
    eta = _pull_on_slack(problem, at)
    nu = problem.barrier_parameter()
    left = torch.arange(len(start), device=start.device)
    for _ in range(MAX_ITERATIONS):
        move, squared = newton(problem, at, eta)
        # The absolute value, because a negative one is all rounding error.
        decrement = squared.abs().sqrt()
        near = decrement < 0.5
        gap = (nu + (decrement + nu.sqrt()) * decrement / (1 - decrement)) / eta
        upper = torch.where(near, at.slack + gap, torch.inf)
        slack = problem.slack(at.action)
        better = slack > found.slack[left]
        found.action[left] = torch.where(better.unsqueeze(-1), at.action, found.action[left])
        found.slack[left] = torch.where(better, slack, found.slack[left])
        found.upper_bound[left] = torch.minimum(found.upper_bound[left], upper)
        lower, upper = found.slack[left], found.upper_bound[left]
        undecided = ~is_settled(lower, upper, scale[left], enough, share)
        if not bool(undecided.any()):
            return found
        at = _line_search(problem, at, move, eta, decrement)
        eta = torch.where(near, eta * _GROWTH, eta)
        if not bool(undecided.all()):
            problem, left = problem.select(undecided), left[undecided]
            nu, eta = nu[undecided], eta[undecided]
            at = Point(*(each[undecided] for each in at))
    raise RuntimeError(
        f"{len(left)} of {len(start)} intersections undecided after {MAX_ITERATIONS} Newton steps; "
        f"the first has slack {found.slack[left][0]:.3g}, at most {found.upper_bound[left][0]:.3g}"
    )


def is_settled(lower: Tensor, upper: Tensor, scale: Tensor, enough: float, share: float) -> Tensor:
    """Tell whether bounds of the best slack say all that is asked, or cannot come much closer."""
    gap = upper - lower
    deep = (lower >= enough) & (gap <= (1 - share) * upper.abs())
    return upper.isfinite() & ((upper < enough) | deep | (gap <= RELATIVE_GAP * scale))


def newton(problem: Program, at: Point, eta: Tensor) -> tuple[Point, Tensor]:
    """Return the Newton direction of ``-eta t + barrier`` and its squared decrement ``(B,)``."""
    distances = problem.distances(at)
    gradient, hessian = _rows_and_cones(problem, at, distances)
    gradient[:, -1] -= eta
    sums = _KinkedSums.at(problem, distances)
    own, eliminated = sums.gradients()
    hessian = hessian + sums.reduced_hessian()
    move = -_solve(hessian, gradient + own - eliminated)
    terms = sums.move_of_terms(move)
    decrement = -((gradient + own) * move).sum(-1) - (sums.gradient * terms).sum((-2, -1))
    return Point(move[:, :-1], move[:, -1], terms), decrement


def _rows_and_cones(problem: Program, at: Point, s: Distances) -> tuple[Tensor, Tensor]:
    """Return gradient and Hessian in (action, slack) of the barriers of rows and cones."""
    inverse = weigh(problem.row_weights, s.rows, torch.reciprocal).unsqueeze(-1)
    rows = torch.cat([problem.rows, problem.row_rates.unsqueeze(-1)], -1) * inverse
    # Cones: -log(h^2 - |y|^2), with z half of its gradient times h^2 - |y|^2.
    white = problem.white(at.action)
    height = problem.cone_sizes - problem.cone_rates * at.slack.unsqueeze(-1)
    inverse = 2 * weigh(problem.cone_weights, s.cone_gaps * s.cone_sums, torch.reciprocal)
    pulled = (problem.matrices * white.unsqueeze(-1)).sum(-2)
    z = torch.cat([pulled, (height * problem.cone_rates).unsqueeze(-1)], -1)
    z = z * inverse.unsqueeze(-1)
    gradient = rows.sum(-2) + z.sum(-2)
    hessian = rows.mT @ rows + z.mT @ z
    matrices = (problem.matrices * inverse.sqrt()[..., None, None]).flatten(1, 2)
    hessian[:, :-1, :-1] += matrices.mT @ matrices
    hessian[:, -1, -1] -= (inverse * problem.cone_rates.square()).sum(-1)
    return gradient, hessian


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
        weights = problem.sum_weights.unsqueeze(-1)
        p = weigh(weights, s.upper, torch.reciprocal)
        q = weigh(weights, s.lower, torch.reciprocal)
        r = weigh(problem.sum_weights, s.sums, torch.reciprocal)
        curvature = torch.where(weights > 0, p.square() + q.square(), 1.0)
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
    height = problem.cone_sizes - problem.cone_rates * at.slack.unsqueeze(-1)
    rows = weigh(problem.row_weights, s.rows, torch.reciprocal) * problem.row_rates
    cones = weigh(problem.cone_weights, s.cone_gaps * s.cone_sums, torch.reciprocal)
    sums = weigh(problem.sum_weights, s.sums, torch.reciprocal) * problem.sum_rates
    return rows.sum(-1) + (2 * cones * height * problem.cone_rates).sum(-1) + sums.sum(-1)


def _line_search(problem: Program, at: Point, move: Point, eta: Tensor, decrement: Tensor) -> Point:
    """Take the best step between the damped Newton step, which always helps, and a full one."""
    share = torch.linspace(1, 0, _TRIALS, dtype=eta.dtype, device=eta.device).unsqueeze(-1)
    steps = (1 + decrement) ** -share
    trials = at.moved(move, steps)
    value = problem.barrier(trials) - eta * (steps * move.slack)
    best = steps.gather(0, value.argmin(0, keepdim=True)).squeeze(0)
    return at.moved(move, best)


def _solve(hessian: Tensor, right: Tensor) -> Tensor:
    """Solve with a positive definite matrix, scaled to a unit diagonal."""
    scale = hessian.diagonal(dim1=-2, dim2=-1).rsqrt()
    factor, failed = torch.linalg.cholesky_ex(hessian * scale.unsqueeze(-1) * scale.unsqueeze(-2))
    if bool(failed.any()):
        # Rounding made the matrix indefinite; a shift of that size gives a descent direction.
        shift = 1e-12 * torch.eye(hessian.shape[-1], dtype=hessian.dtype, device=hessian.device)
        factor = torch.linalg.cholesky(hessian * scale.unsqueeze(-1) * scale.unsqueeze(-2) + shift)
    right = (right * scale).unsqueeze(-1)
    return torch.cholesky_solve(right, factor).squeeze(-1) * scale
