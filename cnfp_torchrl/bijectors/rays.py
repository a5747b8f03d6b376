"""Arithmetic along the rays from a centre, shared by the radial bijectors."""

from __future__ import annotations

import torch
from torch import Tensor

from cnfp_torchrl.bijectors.bijector import broadcast_shape
from cnfp_torchrl.geometry import ConstraintSet, Region


def scaled_direction(offset: Tensor) -> tuple[Tensor, Tensor]:
    """Return an offset scaled to a largest component of one, and whether it was as good as zero.

    Ratios of gauges do not depend on the length of the direction, so the scale needs no gradient;
    in one dimension the direction is a sign and needs none either (its exact zero would come out as
    rounding error over length). An offset of zero, which has no direction, is given one, so that
    nothing becomes NaN; and so is one so short that gradients, which grow like 1/length, could
    overflow when squared (1e-19 in float32, 1e-154 in float64).

    Args:
        offset: ``(*batch, d)``.

    Returns:
        The direction ``(*batch, d)`` and the mask ``(*batch,)``.
    """
    length = offset.detach().abs().amax(-1, keepdim=True)
    zero = length < torch.finfo(offset.dtype).tiny ** 0.5
    if offset.shape[-1] == 1:
        offset = offset.detach()
    # Arithmetic, because torch.where is slow where the mask broadcasts.
    one = zero.to(offset.dtype)
    return (offset + one) / (length + one), zero.squeeze(-1)


def region_shape(region: Region) -> torch.Size:
    """Return the shape ``(*batch, d)`` of a region's actions."""
    active = () if region.active is None else (region.active.shape[:-1],)
    batch = broadcast_shape(region.centre.shape[:-1], *active, *map(set_batch_shape, region.sets))
    return torch.Size((*batch, region.centre.shape[-1]))


def set_batch_shape(each: ConstraintSet) -> torch.Size:
    """Return a set's batch shape, faster than `ConstraintSet.batch_shape` where fields agree."""
    fields = ((getattr(each, name).shape, dims) for name, dims in each.event_dims.items())
    return broadcast_shape(*(shape[: len(shape) - dims] for shape, dims in fields))


def share_of(outer: Tensor, inner: Tensor, zero: Tensor) -> Tensor:
    """Return the share ``outer / inner`` of a ray that remains, from the gauges of its direction.

    Where the inner gauge is the outer one, the share is 1 with a gradient of 0, and not with the
    difference of two equal terms, which would be rounding error over the ray's length. A gauge that
    is NaN makes the share NaN: a broken constraint must not pass for one that does not bind.
    """
    return torch.where(zero | (inner == outer), 1.0, outer / inner)


def is_inside(offset: Tensor, gauge: Tensor, zero: Tensor) -> Tensor:
    """Tell whether an offset stays short of the boundary, given the gauge of its direction."""
    return (offset.abs().amax(-1) * gauge < 1) | zero


def scale_about(centre: Tensor, point: Tensor, factor: Tensor) -> Tensor:
    """Return ``centre + factor (point - centre)``.

    Not ``point - (1 - factor) (point - centre)``: in a small region that would round at the scale
    of the point instead of the region's.

    Args:
        centre: ``(*batch, d)``.
        point: ``(*batch, d)``.
        factor: ``(*batch,)``.
    """
    return centre + factor.unsqueeze(-1) * (point - centre)
