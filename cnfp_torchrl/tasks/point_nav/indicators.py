"""The constraint indicators of point navigation, computed by the environment from its own state.

They share nothing with the geometry that the flow reads, so that a mistake in one of the two shows
up as violations. There is no tolerance: positions and map are float32 numbers, compared in float64.
"""

from __future__ import annotations

import torch
from torch import Tensor


def segment_touches_rectangle(start: Tensor, end: Tensor, rectangles: Tensor) -> Tensor:
    """Tell whether the closed segment touches any closed rectangle.

    Two convex sets are disjoint exactly when an axis separates them; for a segment and a rectangle
    the candidates are the x axis, the y axis and the segment's normal, which separates where all
    corners lie on one side of the segment's line by ``sign(d x (corner - start))``. A segment of
    zero length has no normal: all four products are 0, and the axes decide. On the axes the answer
    is exact; off them the products are rounded to 1e-16 of their size.

    Args:
        start: The segment's one end, ``(*batch, 2)``.
        end: The segment's other end, ``(*batch, 2)``.
        rectangles: The rectangles ``(x_low, y_low, x_high, y_high)``, ``(R, 4)``; R may be 0.

    Returns:
        bool, ``(*batch,)``.
    """
    start, end = start.double().unsqueeze(-2), end.double().unsqueeze(-2)
    low, high = rectangles.double().split(2, dim=-1)
    overlap = (torch.maximum(start, end) >= low) & (torch.minimum(start, end) <= high)

    dx, dy = (end - start).unbind(-1)
    left, bottom = (low - start).unbind(-1)
    right, top = (high - start).unbind(-1)
    side = torch.stack(
        [
            dx * bottom - dy * left,
            dx * bottom - dy * right,
            dx * top - dy * left,
            dx * top - dy * right,
        ],
        dim=-1,
    )
    split_by_normal = (side > 0).all(-1) | (side < 0).all(-1)
    return (overlap.all(-1) & ~split_by_normal).any(-1)


def leaves_arena(position: Tensor, wall: Tensor) -> Tensor:
    """Tell whether a position ``(*batch, 2)``, not yet clipped, lies beyond a wall."""
    return (position.abs() > wall).any(-1)


def battery_low(battery: Tensor, threshold: int) -> Tensor:
    """Tell whether the charge after the step, in whole percent, is below the threshold."""
    return battery < threshold
