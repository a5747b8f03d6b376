"""Points well inside of what rows allow that have just given way, and how good they can be."""

from __future__ import annotations

import numpy as np

from cnfp_torchrl.geometry.anchor.interior_point import Best
from cnfp_torchrl.geometry.anchor.intersection import Intersection
from cnfp_torchrl.geometry.anchor.program import Array, Flags

SHARES = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
"""The shares of the way back, to where the first row would end, at which there is a try."""


def retreat(
    some: Intersection,
    best: Best,
    rooms: Array,
    before: Array,
    gain: Array,
    counts: Flags,
    sure: Flags,
) -> tuple[Array, Array]:
    r"""Move back from points of least relaxation to where there is room in all widened rows.

    Slacks are concave, so that on the way between two points there is no less room than linear
    interpolation says. The weights :math:`w_j` that certified the best slack :math:`t` of the
    maximized rows do so here, too: where rows gave way by :math:`g_j`, no point has more room in
    all of them than :math:`(t + \sum_j w_j g_j) / \sum_j w_j`.

    Args:
        some: B intersections.
        best: Points of the least relaxation.
        rooms: Rooms there in the rows, as they have given way, ``(B, R)``.
        before: Rooms at points strictly inside of the rows that were not maximized, ``(B, R)``.
        gain: Amounts by which the rows gave way, ``(B, R)``.
        counts: Flags of the rows that counted, ``(B, R)``.
        sure: Flags of those of them that hold or have given way, ``(B, R)``; the others may.

    Returns:
        Shares of the way back to these points, ``(B, 1)``, and upper bounds of the smallest room in
        the rows that counted, ``(B,)``.
    """
    # Of rows that may give way later those go on that need not at the best point.
    kept = counts & (sure | (rooms > 0)) & np.isfinite(rooms)
    rooms, change = np.where(kept, rooms, np.inf), np.where(kept, before - rooms, 0.0)
    end = np.clip(np.where(change < 0, rooms / -change, np.inf).min(-1), 0, 1)
    part = np.concatenate([np.zeros((1, len(end))), SHARES[:, None] * end])
    least = (rooms + part[..., None] * change).min(-1)
    chosen = part[least.argmax(0), np.arange(len(end))]
    upper = np.full(len(chosen), np.inf)
    if best.weights is not None:
        at = some.described
        weights = np.where(counts[:, at].T, best.weights, 0.0)
        bound = (best.upper_bound + (weights * gain[:, at].T).sum(0)) / weights.sum(0)
        upper = np.fmin(upper, bound)
    return chosen[:, None], upper
