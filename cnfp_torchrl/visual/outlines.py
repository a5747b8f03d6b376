"""Outlines of sets of actions, for any family of sets, as plain arrays."""

from __future__ import annotations

from collections.abc import Sequence

import contourpy
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cnfp_torchrl.geometry import Box, ConstraintSet, Region

Line = NDArray[np.float64]
"""Points in the plane, ``(points, 2)``."""

View = tuple[float, float, float, float]
"""Lowest and highest first component, lowest and highest second one."""

_FAR = 1e5
"""A set without an end in some direction is drawn up to here, well beyond any view."""
_STRAIGHT, _SAME = 1e-9, 1e-6


class Outlines:
    """Boundaries of sets in the plane of two action components, seen from the region's anchor.

    Along each ray the boundary lies at one over the gauge. In two dimensions that is all there is
    of a set, and in one it is the interval's ends. In more it is the section through the anchor,
    or the shadow that the set casts on the plane.

    Args:
        region: The region of one state, best in float64.
        components: One or two components of the action.
        rays: The number of rays at equal angles; the corners of boxes have rays of their own.
        shadows: Whether shadows are taken, and not sections; slow, and shadows of single sets are
            those of the part within the action bounds, because that of a half-space alone would not
            show it.
    """

    def __init__(
        self,
        region: Region,
        components: Sequence[int],
        *,
        rays: int = 360,
        shadows: bool = False,
    ) -> None:
        chosen, dim = list(components), region.anchor.shape[-1]
        self._anchor = region.anchor[chosen].numpy()
        self._ray = _rays(self._anchor, _corners(region, chosen), rays)
        self._hidden = [i for i in range(dim) if i not in chosen] if shadows else []
        self._direction = region.anchor.new_zeros(dim, len(self._ray)).T
        self._direction[:, chosen] = torch.from_numpy(self._ray).to(region.anchor)
        self._region = region
        self._holds = region.is_active.tolist()
        self._gauges: list[NDArray[np.float64] | None] = [
            constraint.gauge(self._direction, region.anchor).numpy() if self.holds(k) else None
            for k, constraint in enumerate(region.sets)
        ]
        self._boundaries: dict[tuple[int, ...], Line] = {}

    def holds(self, index: int) -> bool:
        """Tell whether a set is active; of a dropped one no inner point is known."""
        return self._holds[index]

    def of_set(self, index: int) -> Line | None:
        """Return the closed boundary of one set, ``(points, m)``; None for a dropped one."""
        if not self.holds(index):
            return None
        return self.of_intersection((0, index) if self._hidden else (index,))

    def of_intersection(self, applied: Sequence[int]) -> Line:
        """Return the closed boundary of the intersection of those sets that hold."""
        key = tuple(k for k in applied if self.holds(k))
        if key not in self._boundaries:
            gauges = [gauge for k in key if (gauge := self._gauges[k]) is not None]
            largest = np.maximum.reduce([np.zeros(len(self._ray)), *gauges])
            if self._hidden and key:
                largest = self._least_gauge(key)
            reach = self._ray / np.maximum(largest, 1 / _FAR)[:, None]
            self._boundaries[key] = self._anchor + reach
        return self._boundaries[key]

    def _least_gauge(self, applied: Sequence[int]) -> NDArray[np.float64]:
        """Return the gauge of the shadow, the least one over the components that are hidden.

        Of a convex function, so that descent finds it; for other sets the shadow is no larger than
        the true one.
        """
        sets, anchor = [self._region.sets[k] for k in applied], self._region.anchor
        rest = torch.zeros(len(self._ray), len(self._hidden), dtype=anchor.dtype)

        def gauge(rest: Tensor) -> Tensor:
            direction = self._direction.index_copy(-1, torch.tensor(self._hidden), rest)
            return torch.stack([constraint.gauge(direction, anchor) for constraint in sets]).amax(0)

        best = gauge(rest)
        with torch.enable_grad():
            rest.requires_grad_()
            optimizer = torch.optim.Adam([rest], lr=0.05)
            schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, gamma=0.98)
            for _ in range(200):
                value = gauge(rest)
                best = torch.minimum(best, value.detach())
                optimizer.zero_grad()
                value.sum().backward()
                optimizer.step()
                schedule.step()
        found: NDArray[np.float64] = best.numpy()
        return found


def set_outline(allowed: ConstraintSet, view: View, nodes: int = 400) -> list[Line]:
    """Return the boundary of a set of actions in the plane, where its slack is zero.

    Works wherever the set lies, also for one that was dropped and has no point in common with the
    region.

    Args:
        allowed: The set, of batch shape ``()`` and dimension 2.
        view: The view, outside of which nothing is drawn.
        nodes: The number of nodes of the grid along each axis.
    """
    x_low, x_high, y_low, y_high = view
    x = torch.linspace(x_low, x_high, nodes, dtype=torch.float64)
    y = torch.linspace(y_low, y_high, nodes, dtype=torch.float64)
    actions = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
    slack = allowed.to(torch.float64).slack(actions)
    # A slack may be infinite; a contour needs numbers on both sides of it.
    slack = slack.nan_to_num(nan=-1e6, posinf=1e6, neginf=-1e6)
    contours = contourpy.contour_generator(x.numpy(), y.numpy(), slack.numpy())
    return [np.asarray(line) for line in contours.lines(0.0)]


def region_outline(region: Region, applied: Sequence[int]) -> Line:
    """Return the closed boundary of an intersection of sets in the plane, as fine as a print needs.

    In more than two dimensions it is the boundary of the shadow on the first two components.

    Args:
        region: A region of batch shape ``()`` and dimension 2 or more.
        applied: The indices into its sets; those that are not active are left out.
    """
    return Outlines(region.to(torch.float64), (0, 1), rays=1440, shadows=True).of_intersection(
        applied
    )


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


def _rays(anchor: Line, corners: Line, count: int) -> Line:
    """Return directions all around, the first one again at the end, and those of the corners."""
    if len(anchor) == 1:
        return np.array([[-1.0], [1.0]])
    x, y = (corners - anchor).T
    angle = np.linspace(-np.pi, np.pi, count + 1)
    angle = np.sort(np.concatenate([angle, np.arctan2(y, x)]))
    # Two equal rays would hide the corner between them from `_simplified`.
    angle = angle[np.diff(angle, prepend=-np.inf) > _SAME]
    ray = np.stack([np.cos(angle), np.sin(angle)]).T
    ray[-1] = ray[0]
    return ray


def _corners(region: Region, chosen: list[int]) -> Line:
    """Return the corners of boxes, which rays at equal angles would cut off, ``(corners, m)``."""
    ends = [
        (box.low.numpy()[chosen], box.high.numpy()[chosen])
        for box in region.sets
        if isinstance(box, Box) and len(chosen) == 2
    ]
    corners = [(x, y) for low, high in ends for x in (low[0], high[0]) for y in (low[1], high[1])]
    found = np.array(corners).reshape(-1, len(chosen))
    return found[np.isfinite(found).all(-1)]
