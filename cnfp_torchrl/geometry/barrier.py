"""A batched interior-point method for the largest smallest slack of several convex sets.

Path-following with the logarithmic barrier: for growing eta, Newton's method minimises
``-eta t + barrier(a, t)``. Every iterate is strictly feasible, so its slack is a lower bound of the
best one; a small Newton decrement certifies an upper bound (Nesterov, Introductory Lectures on
Convex Optimization, 2004, theorem 4.2.7).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cnfp_torchrl.geometry.slack_program import Point, Program, weigh

MAX_ITERATIONS = 500
"""Newton steps before the method gives up with an error; some 30 are usual."""

RELATIVE_GAP = 1e-9
"""How close bounds of the best slack come, relative to the scale, before they count as equal."""

_GROWTH = 20.0
_STEP_SHARES = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)


class Best(NamedTuple):
    """The best found actions ``(B, d)``, their slacks, and upper bounds of the slack ``(B,)``."""

    action: Tensor
    slack: Tensor
    upper_bound: Tensor


def maximise_slack(
    problem: Program, start: Tensor, scale: Tensor, enough: float, share: float
) -> Best:
    """Find actions whose smallest slack is large, and certified upper bounds of it.

    Stops for each problem as soon as the slack is at least `enough` and a share of the upper bound,
    or the upper bound is below `enough`.

    Args:
        problem: B problems in float64.
        start: any actions, ``(B, d)``.
        scale: a length that says how large the problems are, positive, ``(B,)``.
        enough: the smallest slack of interest.
        share: the share of the best slack that will do, below 1.

    Raises:
        RuntimeError: when a problem is undecided after `MAX_ITERATIONS`.
    """
    at = problem.start(start, scale)
    found = Best(start.clone(), problem.slack(start), torch.full_like(scale, torch.inf))
    # The eta for which the start is best in t.
    eta = _pull_on_slack(problem, at)
    nu = problem.barrier_parameter()
    left = torch.arange(len(start), device=start.device)
    for _ in range(MAX_ITERATIONS):
        move, squared = newton(problem, at, eta)
        decrement = squared.clamp(min=0).sqrt()
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


def is_settled(
    lower: Tensor, upper: Tensor, scale: Tensor, enough: float, share: float
) -> Tensor:
    """Tell whether bounds of the best slack say all that is asked, or cannot come much closer."""
    gap = upper - lower
    deep = (lower >= enough) & (gap <= (1 - share) * upper.abs())
    return upper.isfinite() & ((upper < enough) | deep | (gap <= RELATIVE_GAP * scale))


def newton(problem: Program, at: Point, eta: Tensor) -> tuple[Point, Tensor]:
    """Return the Newton direction of ``-eta t + barrier`` and its squared decrement."""
    dim = at.action.shape[-1]
    s = problem.distances(at)

    # Rows: sums of n n^T / s^2 in (action, slack).
    inverse = weigh(problem.row_weights, s.rows, torch.reciprocal)
    normals = torch.cat([problem.rows, problem.row_rates.unsqueeze(-1)], -1)
    gradient = (normals * inverse.unsqueeze(-1)).sum(-2)
    scaled = normals * inverse.unsqueeze(-1)
    hessian = scaled.mT @ scaled

    # Cones: -log(h^2 - |y|^2).
    white = problem.white(at.action)
    height = problem.cone_sizes - problem.cone_rates * at.slack.unsqueeze(-1)
    inverse = weigh(problem.cone_weights, s.cone_gaps * s.cone_sums, torch.reciprocal)
    pulled = (problem.matrices * white.unsqueeze(-1)).sum(-2)
    z = torch.cat([pulled, (height * problem.cone_rates).unsqueeze(-1)], -1)
    z = z * (2 * inverse).unsqueeze(-1)
    gradient = gradient + z.sum(-2)
    hessian = hessian + z.mT @ z
    scaled = problem.matrices * (2 * inverse).sqrt()[..., None, None]
    scaled = scaled.flatten(1, 2)
    hessian[:, :dim, :dim] += scaled.mT @ scaled
    hessian[:, dim, dim] -= (2 * inverse * problem.cone_rates.square()).sum(-1)

    # Kinked sums: each term's bound u_i is eliminated, which leaves a diagonal and one row.
    weights = problem.sum_weights.unsqueeze(-1)
    p = weigh(weights, s.upper, torch.reciprocal)
    q = weigh(weights, s.lower, torch.reciprocal)
    r = weigh(problem.sum_weights, s.sums, torch.reciprocal)
    curvature = torch.where(weights > 0, p.square() + q.square(), 1.0)
    spread = (weights / curvature).sum(-1)
    mean = (problem.upper * p.square() + problem.lower * q.square()) / curvature
    kappa = r.square() / (1 + r.square() * spread)
    term_gradient = r.unsqueeze(-1) - p - q
    relaxed = term_gradient / curvature
    # (D + r^2 1 1^T)^-1 g, by Sherman and Morrison.
    relaxed = relaxed - (kappa * relaxed.sum(-1)).unsqueeze(-1) * weights / curvature
    row = torch.cat([mean, problem.sum_rates.unsqueeze(-1)], -1)
    diagonal = (p * q * (problem.upper - problem.lower)).square() / curvature
    gradient[:, :dim] += (problem.upper * p + problem.lower * q).sum(-2)
    gradient[:, dim] += (problem.sum_rates * r).sum(-1)
    # Minus H_xu H_uu^-1 g_u: what the eliminated bounds leave behind.
    curved = (problem.upper * p.square() + problem.lower * q.square()) * relaxed
    reduced = gradient.clone()
    reduced[:, :dim] += curved.sum(-2)
    reduced[:, dim] -= (problem.sum_rates * r.square() * relaxed.sum(-1)).sum(-1)
    reduced[:, dim] -= eta
    gradient[:, dim] -= eta
    hessian = hessian + (row * kappa.unsqueeze(-1)).mT @ row
    hessian[:, :dim, :dim] += torch.diag_embed(diagonal.sum(-2))

    move = -_solve(hessian, reduced)
    d_action, d_slack = move[:, :dim], move[:, dim]
    # H_uu du = -(g_u + H_ux dx)
    pull = (problem.upper * p.square() + problem.lower * q.square()) * d_action.unsqueeze(-2)
    pull = pull - (problem.sum_rates * r.square() * d_slack.unsqueeze(-1)).unsqueeze(-1)
    d_terms = (pull - term_gradient) / curvature
    d_terms = d_terms - (kappa * d_terms.sum(-1)).unsqueeze(-1) * weights / curvature
    d_terms = d_terms * weights
    decrement = -(gradient * move).sum(-1) - (term_gradient * d_terms).sum((-2, -1))
    return Point(d_action, d_slack, d_terms), decrement


def _pull_on_slack(problem: Program, at: Point) -> Tensor:
    s = problem.distances(at)
    height = problem.cone_sizes - problem.cone_rates * at.slack.unsqueeze(-1)
    rows = weigh(problem.row_weights, s.rows, torch.reciprocal) * problem.row_rates
    cones = weigh(problem.cone_weights, s.cone_gaps * s.cone_sums, torch.reciprocal)
    sums = weigh(problem.sum_weights, s.sums, torch.reciprocal) * problem.sum_rates
    return rows.sum(-1) + (2 * cones * height * problem.cone_rates).sum(-1) + sums.sum(-1)


def _line_search(problem: Program, at: Point, move: Point, eta: Tensor, decrement: Tensor) -> Point:
    """Take the best of a few steps; the damped Newton step, the first, always makes progress."""
    damped = 1 / (1 + decrement)
    shares = torch.tensor(_STEP_SHARES, dtype=eta.dtype, device=eta.device)
    steps = damped * shares.unsqueeze(-1)
    steps = torch.cat([steps, torch.ones_like(damped).unsqueeze(0)])
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
