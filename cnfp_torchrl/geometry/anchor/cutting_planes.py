"""The largest smallest slack in sets some of which state a concave slack alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from cnfp_torchrl.geometry.anchor.interior_point import Best, Settled, maximize_slack
from cnfp_torchrl.geometry.anchor.program import Array, Flags, Index, Program
from cnfp_torchrl.geometry.constraint_set import ConstraintSet

MAX_CUTS = 300
"""The number of linearizations of each set after which the best point so far is taken."""


def maximize_slack_by_cuts(
    problem: Program,
    sets: Sequence[ConstraintSet],
    required: Array,
    maximized: Flags,
    counts: Flags,
    start: Array,
    settled: Settled,
) -> Best:
    r"""Do what `maximize_slack` does with further sets, of which only the slack is known.

    A concave slack lies below its linearizations, :math:`slack(x) \le slack(a) + g \cdot (x - a)`:
    rows that are added at each point found (Kelley 1960, at points well inside the rows so far).
    Upper bounds hold for the rows, so for the sets. A point outside of a set that must hold is
    drawn back towards the start until it is inside.

    Args:
        problem: B problems, without the sets.
        sets: Further sets, each of batch shape ``(B,)``, in float64 on the CPU.
        required: Slacks that the maximized ones exceed by t, ``(B, len(sets))``.
        maximized: Flags of the maximized sets, ``(B, len(sets))``.
        counts: Flags of the sets that count, ``(B, len(sets))``.
        start: Points strictly inside of all that must hold, ``(B, d)``.
        settled: The function that tells which problems need no more work.
    """
    batch = len(start)
    found = Best(start.copy(), np.full(batch, -np.inf), np.full(batch, np.inf))
    left = np.arange(batch)
    for _ in range(MAX_CUTS):
        at, needs, rising, on = start[left], required[left], maximized[left], counts[left]

        def half_settled(lower: Array, upper: Array, index: Index) -> Flags:
            """Tell where a point is well inside the rows so far."""
            total = left[index]  # noqa: B023 - called before left changes
            lowest = found.slack[total]
            return (lower - lowest >= (upper - lowest) / 2) | settled(lower, upper, total)

        best = maximize_slack(problem, at, half_settled)
        slacks, gradients = _linearized(sets, left, batch, best.action)
        rooms = slacks - needs
        rooms_at_start = _slacks(sets, left, batch, at) - needs
        # Of what must hold, at least the chord to the start does.
        outside, share = (rooms < 0) & ~rising & on, np.ones_like(rooms)
        np.divide(rooms_at_start, rooms_at_start - rooms, out=share, where=outside)
        share = share.min(-1, keepdims=True)
        action = at + share * (best.action - at)
        rooms = _slacks(sets, left, batch, action) - needs
        slack = np.where(on & rising, rooms, np.inf).min(-1)
        slack = np.minimum(slack, problem.slack(action))
        better = slack > found.slack[left]
        found.action[left] = np.where(better[:, None], action, found.action[left])
        found.slack[left] = np.where(better, slack, found.slack[left])
        found.upper_bound[left] = np.minimum(found.upper_bound[left], best.upper_bound)
        undecided = ~settled(found.slack[left], found.upper_bound[left], left)
        if not undecided.any():
            break
        offsets = slacks - needs - (gradients * best.action[:, None]).sum(-1)
        normals = -np.moveaxis(gradients, 0, -1)
        problem = problem.with_rows(normals, offsets.T, rising.T, on.T).select(undecided)
        left = left[undecided]
    return found


def _slacks(sets: Sequence[ConstraintSet], index: Index, batch: int, action: Array) -> Array:
    """Return slacks ``(B, len(sets))``."""
    shape, at = torch.Size([batch]), torch.from_numpy(index)
    slacks = [s.select(shape, at).slack(torch.from_numpy(action)).numpy() for s in sets]
    return np.stack(slacks, -1)


def _linearized(
    sets: Sequence[ConstraintSet], index: Index, batch: int, action: Array
) -> tuple[Array, Array]:
    """Return slacks ``(B, len(sets))`` and their gradients ``(B, len(sets), d)``."""
    slacks, gradients = [], []
    for constraint_set in sets:
        with torch.enable_grad():
            at = torch.from_numpy(action).requires_grad_()
            chosen = constraint_set.select(torch.Size([batch]), torch.from_numpy(index))
            slack = chosen.slack(at)
            gradients.append(torch.autograd.grad(slack.sum(), at)[0].numpy())
        slacks.append(slack.detach().numpy())
    return np.stack(slacks, -1), np.stack(gradients, -2)
