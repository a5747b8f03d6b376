"""Least relaxations in closed form, where a single inequality over a box decides."""

from __future__ import annotations

import numpy as np

from cnfp_torchrl.geometry.anchor.interior_point import Best, Settled, maximize_slack
from cnfp_torchrl.geometry.anchor.program import Array, Flags, Index, Program

_ROUNDING = 1e-12
"""The amount by which a side of the box may be missed, in mean half widths."""

_APART = 1e-2
"""The least difference to the other maximized slacks, in mean half widths.

Of slacks that are equal by chance, Newton's method finds out which can grow.
"""


def maximize_slack_over_box(problem: Program, start: Array, settled: Settled) -> Best:
    """Do what `maximize_slack` does, in closed form for the problems in which it has one.

    What must hold and depends on one component alone makes a box. No maximized slack exceeds its
    own largest one over the box; where the others are no smaller at the point that has it, and all
    else holds there, that point is best. A ball out of reach is such a case, or a row.

    Args:
        problem: B problems, in which the bounds of the actions must hold.
        start: Points strictly inside of what is not maximized, ``(B, d)``.
        settled: The function that tells which problems need no more work.
    """
    with np.errstate(all="ignore"):
        best = _best_over_box(problem, start)
    every = np.arange(len(start))
    left = (~settled(best.slack, best.upper_bound, every)).nonzero()[0]
    if not len(left):
        return best
    if len(left) == len(start):
        return maximize_slack(problem, start, settled)

    def still_settled(lower: Array, upper: Array, index: Index) -> Flags:
        return settled(lower, upper, left[index])

    rest = maximize_slack(problem.select(left), start[left], still_settled)
    best.action[left], best.slack[left], best.upper_bound[left] = rest[:3]
    assert best.weights is not None
    assert rest.weights is not None
    best.weights[:, left] = rest.weights
    return best


def _best_over_box(problem: Program, start: Array) -> Best:
    """Return candidates, their slacks or -inf where they are none, and certified bounds."""
    first, dim, batch = 2 * len(problem.reach), problem.dim, np.arange(len(start))
    rows, offsets, rates = problem.rows[first:, :dim], problem.offsets[first:], problem.rates()
    single = ((rows != 0).sum(1) == 1) & (rates[: len(rows)] == 0)
    crossing = offsets[:, None] / rows
    highs = np.where(single[:, None] & (rows > 0), crossing, np.inf)
    lows = np.where(single[:, None] & (rows < 0), crossing, -np.inf)
    low, high = lows.max(0), highs.min(0)
    near = np.clip((start.T - problem.middle) / problem.half, low, high)
    # The best points of each inequality, and its slack's gradients there.
    points = np.where(rows > 0, low, np.where(rows < 0, high, near))
    most, gradients = offsets - (rows * points).sum(1), -rows
    for cone, tip in zip(problem.cones, problem.tips, strict=True):
        # Separable where the matrix is diagonal, as a ball's.
        slope, point, rest = cone[1:, :dim], near.copy(), cone[1:, :dim].copy()
        axes = np.arange(min(rest.shape[:2]))
        diagonal = slope[axes, axes]
        rest[axes, axes] = 0
        wanted = np.where(diagonal == 0, near[axes], tip[1 + axes] / diagonal)
        point[axes] = np.clip(wanted, low[axes], high[axes])
        away = tip[1:] - (slope * point).sum(1)
        length = np.sqrt(np.square(away).sum(0))
        pull = (slope * away[:, None]).sum(0) / np.where(length > 0, length, 1)
        slack = np.where(rest.any((0, 1)), np.inf, tip[0] - length)
        points, gradients = (np.concatenate(v) for v in ((points, [point]), (gradients, [pull])))
        most = np.concatenate([most, [slack]])
    bounds = np.where(rates > 0, most, np.inf)
    decides = bounds.argmin(0)
    upper = bounds[decides, batch]
    x, gradient = problem.lifted(points[decides, :, batch].T), gradients[decides, :, batch].T
    rooms = problem.rooms(x)
    slack = rooms[decides, batch]
    others = np.where(rates > 0, rooms - slack - _APART, rooms + _ROUNDING)
    others[decides, batch] = 0
    slack = np.where((others >= 0).all(0), slack, -np.inf)
    weights = np.zeros_like(rates)
    weights[decides, batch] = 1
    # Sides of the box count by the gradient.
    side = np.where(gradient > 0, highs.argmin(0), lows.argmax(0))
    steepness = rows[side, np.arange(dim)[:, None], batch]
    weights[side, batch] += np.where(gradient == 0, 0.0, np.abs(gradient / steepness))
    return Best(problem.action(x), slack * problem.unit, upper * problem.unit, weights)
