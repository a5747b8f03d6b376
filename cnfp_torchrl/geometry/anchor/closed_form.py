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
    near = (start.T - problem.middle) / problem.half
    most = [offsets - np.minimum(rows * low, rows * high).sum(1)]
    nearest = np.empty((len(problem.cones), dim, len(start)))
    for i, (cone, tip) in enumerate(zip(problem.cones, problem.tips, strict=True)):
        # Separable where the matrix is diagonal, as a ball's.
        slope, rest = cone[1:, :dim], cone[1:, :dim].copy()
        axes = np.arange(min(rest.shape[:2]))
        rest[axes, axes] = 0
        diagonal = slope[axes, axes]
        wanted = np.where(diagonal == 0, near[axes], tip[1 + axes] / diagonal)
        nearest[i] = near
        nearest[i, axes] = np.clip(wanted, low[axes], high[axes])
        away = tip[1:] - (slope * nearest[i]).sum(1)
        separable = ~rest.any((0, 1))
        most.append(np.where(separable, tip[0] - np.sqrt(np.square(away).sum(0)), np.inf)[None])
    bounds = np.where(rates > 0, np.concatenate(most), np.inf)
    decides = bounds.argmin(0)
    upper = bounds[decides, batch]
    # The slack's gradient at the point, by which the sides of the box count.
    is_row = decides < len(rows)
    row = rows[np.where(is_row, decides, 0), :, batch].T
    corner = np.where(row > 0, low, np.where(row < 0, high, np.clip(near, low, high)))
    point, gradient = corner, -row
    if len(problem.cones):
        which = np.where(is_row, 0, decides - len(rows))
        point = np.where(is_row, corner, nearest[which, :, batch].T)
        slope = np.moveaxis(problem.cones[which, 1:, :dim, batch], 0, -1)
        away = problem.tips[which, 1:, batch].T - (slope * point).sum(1)
        length = np.sqrt(np.square(away).sum(0))
        pull = (slope * away[:, None]).sum(0) / np.where(length > 0, length, 1)
        gradient = np.where(is_row, gradient, pull)
    x = problem.at(np.ascontiguousarray((problem.middle + problem.half * point).T))
    rooms = problem.rooms(x)
    slack = rooms[decides, batch]
    others = np.where(rates > 0, rooms - slack - _APART, rooms + _ROUNDING)
    others[decides, batch] = 0
    slack = np.where((others >= 0).all(0), slack, -np.inf)
    weights = np.zeros_like(rates)
    weights[decides, batch] = 1
    side = np.where(gradient > 0, highs.argmin(0), lows.argmax(0))
    steepness = rows[side, np.arange(dim)[:, None], batch]
    weights[side, batch] += np.where(gradient == 0, 0.0, np.abs(gradient / steepness))
    return Best(problem.action(x), slack * problem.unit, upper * problem.unit, weights)
