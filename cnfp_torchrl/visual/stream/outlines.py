"""Outlines of sets of actions in a plane or on a line, quick enough for every step."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cnfp_torchrl.geometry import Box, Region
from cnfp_torchrl.visual.outlines import Line, View

_RAYS = 360
_FAR = 1e5
"""A set without an end in some direction is drawn up to here, well beyond any view."""
_STRAIGHT, _SAME = 1e-9, 1e-6


class RayOutlines:
    """Boundaries of sets in the plane of two action components, seen from the region's centre.

    Along each ray the boundary lies at one over the gauge. In two dimensions that is all there is
    of a set; in more it is the section through the centre, and in one it is the interval's ends.

    Args:
        region: of one state.
        components: one or two components of the action.
    """

    def __init__(self, region: Region, components: Sequence[int]) -> None:
        chosen = list(components)
        self._centre = region.centre[chosen]
        self._ray = _rays(self._centre, _corners(region, chosen))
        direction = self._ray.new_zeros(len(self._ray), region.centre.shape[-1])
        direction[:, chosen] = self._ray
        self._gauges = [
            each.gauge(direction, region.centre)
            if region.active is None or bool(region.active[k])
            else None
            for k, each in enumerate(region.sets)
        ]

    def of_set(self, index: int) -> Line | None:
        """Return the closed boundary of one set, ``(points, m)``; None for a dropped one."""
        gauge = self._gauges[index]
        return None if gauge is None else self._boundary(gauge)

    def of_intersection(self, applied: Sequence[int]) -> Line:
        """Return the closed boundary of the intersection of those sets that hold."""
        gauges = [gauge for k in applied if (gauge := self._gauges[k]) is not None]
        return self._boundary(torch.stack([self._ray.new_zeros(len(self._ray)), *gauges]).amax(0))

    def _boundary(self, gauge: Tensor) -> Line:
        boundary: Line = (self._centre + self._ray / gauge.clamp(min=1 / _FAR)[:, None]).numpy()
        return boundary


def within(line: Line, view: View) -> list[Line]:
    """Return the pieces of a line ``(points, 2)`` that lie in a view, without needless points."""
    x_low, x_high, y_low, y_high = view
    low, high = np.array([x_low, y_low]), np.array([x_high, y_high])
    inside: NDArray[np.bool_] = np.asarray(((line >= low) & (line <= high)).all(-1))
    if inside.all():
        return [_simplified(line)]
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
    before, after = line[1:-1] - line[:-2], line[2:] - line[1:-1]
    bends = np.abs(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]) > _STRAIGHT
    return line[np.concatenate([[True], bends, [True]])]


def _rays(centre: Tensor, corners: Tensor) -> Tensor:
    """Return directions all around, the first one again at the end, and those of the corners."""
    if len(centre) == 1:
        return centre.new_tensor([[-1.0], [1.0]])
    angle = torch.linspace(-torch.pi, torch.pi, _RAYS + 1, dtype=centre.dtype)
    x, y = (corners - centre).unbind(-1)
    angle = torch.cat([angle, torch.atan2(y, x)]).sort().values
    # Two equal rays would hide the corner between them from `_simplified`.
    angle = angle[torch.cat([angle.new_ones(1), angle.diff()]) > _SAME]
    ray = torch.stack([angle.cos(), angle.sin()], dim=-1)
    ray[-1] = ray[0]
    return ray


def _corners(region: Region, chosen: list[int]) -> Tensor:
    """Return the corners of boxes, which rays at equal angles would cut off, ``(corners, m)``."""
    ends = [
        torch.stack([each.low[chosen], each.high[chosen]])
        for each in region.sets
        if isinstance(each, Box) and len(chosen) == 2
    ]
    corners = [torch.cartesian_prod(*each.T) for each in ends]
    found = torch.cat([region.centre.new_zeros(0, len(chosen)), *corners])
    return found[found.isfinite().all(-1)]
