"""Outlines of sets of actions in a plane or on a line, quick enough for every step."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from cnfp_torchrl.geometry import Box, Region
from cnfp_torchrl.visual.outlines import Line, View

_ANGLES = np.linspace(-np.pi, np.pi, 361)
_FAR = 1e5
"""A set without an end in some direction is drawn up to here, well beyond any view."""
_STRAIGHT, _SAME = 1e-9, 1e-6


class RayOutlines:
    """Boundaries of sets in the plane of two action components, seen from the region's anchor.

    Along each ray the boundary lies at one over the gauge. In two dimensions that is all there is
    of a set; in more it is the section through the anchor, and in one it is the interval's ends.

    Args:
        region: of one state.
        components: one or two components of the action.
    """

    def __init__(self, region: Region, components: Sequence[int]) -> None:
        chosen = list(components)
        self._anchor = region.anchor[chosen].numpy()
        self._ray = _rays(self._anchor, _corners(region, chosen))
        direction = region.anchor.new_zeros(region.anchor.shape[-1], len(self._ray)).T
        direction[:, chosen] = torch.from_numpy(self._ray)
        self._gauges = [
            each.gauge(direction, region.anchor).numpy()
            if region.active is None or bool(region.active[k])
            else None
            for k, each in enumerate(region.sets)
        ]
        self._boundaries: dict[tuple[int, ...], Line] = {}

    def of_set(self, index: int) -> Line | None:
        """Return the closed boundary of one set, ``(points, m)``; None for a dropped one."""
        return None if self._gauges[index] is None else self.of_intersection((index,))

    def of_intersection(self, applied: Sequence[int]) -> Line:
        """Return the closed boundary of the intersection of those sets that hold."""
        key = tuple(applied)
        if key not in self._boundaries:
            gauges = [gauge for k in key if (gauge := self._gauges[k]) is not None]
            largest = np.maximum.reduce([np.full(len(self._ray), 1 / _FAR), *gauges])
            self._boundaries[key] = self._anchor + self._ray / largest[:, None]
        return self._boundaries[key]


def within(line: Line, view: View) -> list[Line]:
    """Return the pieces of a line ``(points, 2)`` that lie in a view, without needless points."""
    x_low, x_high, y_low, y_high = view
    x, y = line.T
    inside: NDArray[np.bool_] = (x >= x_low) & (x <= x_high) & (y >= y_low) & (y <= y_high)
    if inside.all():
        return [_simplified(line)]
    if not inside.any():
        return []
    low, high = np.array([x_low, y_low]), np.array([x_high, y_high])
    if np.array_equal(line[0], line[-1]):
        # A closed line has no ends of its own: it begins where it is out of view.
        start = int(np.argmin(inside))
        line = np.concatenate([line[start:-1], line[: start + 1]])
        inside = np.concatenate([inside[start:-1], inside[: start + 1]])
    pieces = []
    # The first point of each run inside, and the one after its last.
    steps = np.diff(inside.astype(np.int8), prepend=0, append=0)
    starts, stops = np.flatnonzero(steps == 1).tolist(), np.flatnonzero(steps == -1).tolist()
    for start, stop in zip(starts, stops, strict=True):
        piece = [line[start:stop]]
        if start > 0:
            piece.insert(0, _cut(line[start], line[start - 1], low, high))
        if stop < len(line):
            piece.append(_cut(line[stop - 1], line[stop], low, high))
        pieces.append(_simplified(np.concatenate(piece)))
    return pieces


def _cut(inner: Line, outer: Line, low: Line, high: Line) -> Line:
    """Return where the segment from an inner to an outer point leaves a box, ``(1, 2)``."""
    way = outer - inner
    room = np.where(way > 0, high - inner, low - inner)
    share = np.divide(room, way, out=np.ones_like(way), where=way != 0).min()
    cut: Line = (inner + min(share, 1.0) * way)[None]
    return cut


def _simplified(line: Line) -> Line:
    """Return the line without points in the middle of straight parts."""
    if len(line) < 3:
        return line
    x, y = line.T
    dx, dy = x[1:] - x[:-1], y[1:] - y[:-1]
    keep = np.ones(len(line), dtype=bool)
    keep[1:-1] = np.abs(dx[:-1] * dy[1:] - dy[:-1] * dx[1:]) > _STRAIGHT
    return line[keep]


def _rays(anchor: Line, corners: Line) -> Line:
    """Return directions all around, the first one again at the end, and those of the corners."""
    if len(anchor) == 1:
        return np.array([[-1.0], [1.0]])
    x, y = (corners - anchor).T
    angle = np.sort(np.concatenate([_ANGLES, np.arctan2(y, x)]))
    # Two equal rays would hide the corner between them from `_simplified`.
    angle = angle[np.diff(angle, prepend=-np.inf) > _SAME]
    ray = np.stack([np.cos(angle), np.sin(angle)]).T
    ray[-1] = ray[0]
    return ray


def _corners(region: Region, chosen: list[int]) -> Line:
    """Return the corners of boxes, which rays at equal angles would cut off, ``(corners, m)``."""
    ends = [
        (each.low.numpy()[chosen], each.high.numpy()[chosen])
        for each in region.sets
        if isinstance(each, Box) and len(chosen) == 2
    ]
    corners = [(x, y) for low, high in ends for x in (low[0], high[0]) for y in (low[1], high[1])]
    found = np.array(corners).reshape(-1, len(chosen))
    return found[np.isfinite(found).all(-1)]
