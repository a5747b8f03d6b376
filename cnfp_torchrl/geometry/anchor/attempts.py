"""Cheap attempts at the anchor: a fixed number of passes over all states, no search."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from cnfp_torchrl.geometry.anchor.depth import row_depths, bounds_of
from cnfp_torchrl.geometry.constraint_set import ConstraintSet


def attempt_anchor(
    sets: Sequence[ConstraintSet], candidate: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    bounds = bounds_of(sets)
    depths = row_depths(sets)
    low = torch.stack(torch.broadcast_tensors(*(each.bounding_box().low for each in sets))).amax(0)
    high = torch.stack(torch.broadcast_tensors(*(each.bounding_box().high for each in sets))).amin(0)
    middle = (low + high) / 2
    room = torch.stack(torch.broadcast_tensors(*[(each.row_slacks(middle) - depth).amin(-1) for each, depth in zip(sets, depths)])).amin(0)
    decided = (room >= 0) & (room >= 0.3 * (high - low).amin(-1) / 2)
    return middle.expand(*decided.shape, -1), decided
