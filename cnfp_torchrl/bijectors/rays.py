"""Arithmetic along the rays from an anchor, shared by the radial bijectors."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import threshold

from cnfp_torchrl.geometry import Region
from cnfp_torchrl.geometry.constraint_set import Gauge
from cnfp_torchrl.geometry.shapes import broadcast_shape


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
    sets = (each.batch_shape for each in region.sets)
    batch = broadcast_shape(region.anchor.shape[:-1], *active, *sets)
    return torch.Size((*batch, region.anchor.shape[-1]))


class Rays:
    """The rays from an anchor through points of an outer set.

    Args:
        offset: points minus the anchor, ``(*batch, d)``.
        progress: the share of the way to the outer boundary at which each point lies, the outer
            set's gauge of its offset, ``(*batch,)``.
    """

    def __init__(self, offset: Tensor, progress: Tensor) -> None:
        # In one dimension a direction is a sign and has no gradient; computed, its exact zero would
        # be rounding error over the length.
        if offset.shape[-1] == 1:
            offset, progress = offset.detach(), progress.detach()
        # An offset of zero has no direction, and one so short that gradients, which grow like
        # 1/length, could overflow when squared, has none to speak of. It is given one, so that
        # nothing becomes NaN, and a way to the boundary on which no set binds.
        shortest = torch.finfo(offset.dtype).tiny ** 0.4
        zero = progress <= shortest
        self._direction = offset + zero.unsqueeze(-1)
        self._outer = threshold(progress, shortest, torch.inf)

    def contraction(self, inner: Sequence[Gauge]) -> Tensor:
        """Return by what a way through the outer set is divided to end in the inner ones as well.

        The larger one of all gauges over the outer one, and 1 for an offset of zero. Where no inner
        set binds it is exactly 1, and its gradient 0. An inner gauge of NaN makes it NaN: a broken
        constraint must not pass for one that does not bind.

        Args:
            inner: the gauges of one or more inner sets about the anchor.
        """
        gauges = [gauge(self._direction) for gauge in inner]
        if len(gauges) == 1:
            largest = gauges[0]
        else:
            # Not one maximum after the other: each gradient costs as much as that of all at once.
            largest = torch.stack(torch.broadcast_tensors(*gauges)).amax(0)
        # The larger one of it and 1; the gradient of clamp takes more passes.
        return threshold(largest / self._outer, 1, 1)
