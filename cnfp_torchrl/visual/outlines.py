"""Outlines of sets of actions, for any family of sets, as plain arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import contourpy
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cnfp_torchrl.geometry import ConstraintSet, Region

Line = NDArray[np.float64]
"""Points in the plane, ``(points, 2)``."""

View = tuple[float, float, float, float]
"""Lowest and highest first component, lowest and highest second one."""

_RAYS = 1440
_GRID = 400
_FAR = 1e4
"""A set without an end in some direction is drawn up to here, well beyond any view."""


def set_outline(each: ConstraintSet, view: View, nodes: int | None = None) -> list[Line]:
    """Return the boundary of a set of actions in the plane, where its slack is zero.

    Works wherever the set lies, also for one that was dropped and has no point in common with the
    region.

    Args:
        each: one set, of batch shape ``()`` and dimension 2.
        view: outside of it nothing is drawn.
        nodes: of the grid along each axis; None takes as many as a figure needs.
    """
    x_low, x_high, y_low, y_high = view
    x = torch.linspace(x_low, x_high, nodes or _GRID, dtype=torch.float64)
    y = torch.linspace(y_low, y_high, nodes or _GRID, dtype=torch.float64)
    actions = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
    slack = each.to(torch.float64).slack(actions)
    # A slack may be infinite; a contour needs numbers on both sides of it.
    slack = slack.nan_to_num(nan=-1e6, posinf=1e6, neginf=-1e6)
    contours = contourpy.contour_generator(x.numpy(), y.numpy(), slack.numpy())
    return [np.asarray(line) for line in contours.lines(0.0)]


def region_outline(region: Region, applied: Sequence[int]) -> Line:
    """Return the closed boundary of the intersection of some sets, seen from the region's anchor.

    Along each ray the boundary lies at one over the largest gauge. In more than two dimensions it
    is the boundary of the shadow that the intersection casts on the first two components.

    Args:
        region: of batch shape ``()`` and dimension 2 or more.
        applied: indices into its sets; those that are not active are left out.
    """
    rays = _RAYS if region.anchor.shape[-1] == 2 else _RAYS // 2
    angle = torch.linspace(0, 2 * torch.pi, rays + 1, dtype=torch.float64)
    ray = torch.stack([angle.cos(), angle.sin()], dim=-1)
    gauge = shadow_gauge(region, applied, ray)
    boundary = region.anchor[:2].double() + ray / gauge.clamp(min=1 / _FAR).unsqueeze(-1)
    return boundary.numpy()


def interval(region: Region, applied: Sequence[int]) -> tuple[float, float]:
    """Return the ends of the intersection of some sets along the first component."""
    ray = torch.zeros(2, 1, dtype=torch.float64)
    ray[0], ray[1] = -1, 1
    gauge = shadow_gauge(region, applied, ray).clamp(min=1 / _FAR)
    low, high = (region.anchor[0].double() + ray.squeeze(-1) / gauge).tolist()
    return low, high


def shadow_gauge(region: Region, applied: Sequence[int], ray: Tensor) -> Tensor:
    """Return the gauge, about the region's anchor, of an intersection's shadow on the first axes.

    The gauge of a projection is the least gauge over the components that are projected away. Of a
    convex function, so that descent finds it; for other sets the shadow is no larger than the true
    one.

    Args:
        region: of batch shape ``()``, dimension d.
        applied: indices into its sets; those that are not active are left out.
        ray: directions in the first m <= d components, ``(rays, m)``.
    """
    sets = [
        region.sets[k].to(torch.float64)
        for k in applied
        if region.active is None or bool(region.active[k])
    ]
    anchor = region.anchor.double()
    hidden = anchor.shape[-1] - ray.shape[-1]

    def gauge(rest: Tensor) -> Tensor:
        direction = torch.cat([ray, rest], dim=-1)
        each = [a_set.gauge(direction, anchor) for a_set in sets]
        return torch.stack([torch.zeros(len(ray), dtype=ray.dtype), *each]).amax(0)

    rest = torch.zeros(len(ray), hidden, dtype=ray.dtype)
    if hidden == 0 or not sets:
        return gauge(rest)
    with torch.enable_grad():
        return _least(gauge, rest)


def _least(function: Callable[[Tensor], Tensor], start: Tensor) -> Tensor:
    """Return the least values, one for each row, that descent from the start finds."""
    rest = start.clone().requires_grad_()
    optimizer = torch.optim.Adam([rest], lr=0.05)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, gamma=0.98)
    best = function(start)
    for _ in range(200):
        value = function(rest)
        best = torch.minimum(best, value.detach())
        optimizer.zero_grad()
        value.sum().backward()
        optimizer.step()
        schedule.step()
    return best
