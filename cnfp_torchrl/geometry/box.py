"""Boxes: independent bounds for each action component."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, NamedTuple, Self

import torch
from torch import Tensor

from cnfp_torchrl.geometry.constraint_set import (
    EROSION_IN_EPS,
    Bounds,
    ConstraintSet,
    Gauge,
    GeometryError,
)
from cnfp_torchrl.geometry.superlevel import Rows


class _Kept(NamedTuple):
    """What is known of a box: its size, and for points of that size erosion and rounding."""

    magnitude: Tensor
    width: Tensor
    eroded: Any
    rounding: Tensor


ACTION_RANGE = {torch.float32: (1e-7, 1e18), torch.float64: (1e-30, 1e150)}
"""The least width and the largest number of action bounds, by dtype, as flows square actions."""


@dataclass(frozen=True, eq=False)
class Box(ConstraintSet):
    r"""The box :math:`\{a : low \le a \le high\}`; infinite bounds are allowed.

    Args:
        low: Lower bounds ``(*batch, d)``.
        high: Upper bounds ``(*batch, d)``, none less than its lower bound.
    """

    low: Tensor
    high: Tensor

    event_dims: ClassVar[Mapping[str, int]] = {"low": 1, "high": 1}
    # An instance's own where it is prepared.
    _kept: ClassVar[_Kept | None] = None
    _halves: ClassVar[tuple[Tensor, Tensor] | None] = None

    def invalid_fields(self) -> Iterator[tuple[str, Tensor, str]]:
        # NaN where both are the same infinity.
        yield "low", ~(self.high - self.low >= 0), "low <= high, not the same infinity"

    def contains(self, action: Tensor) -> Tensor:
        return ((action >= self.low) & (action <= self.high)).all(-1)

    def slack(self, action: Tensor) -> Tensor:
        return torch.minimum(self.high - action, action - self.low).amin(-1)

    def row_slacks(self, action: Tensor) -> Tensor:
        """Return the distances to the high bounds, then to the low bounds, ``(*batch, 2d)``."""
        return torch.cat(torch.broadcast_tensors(self.high - action, action - self.low), -1)

    def inflated(self, by: Tensor) -> Self:
        above, below = (by, by) if by.shape[-1] == 1 else by.chunk(2, -1)
        return type(self)(self.low - below, self.high + above, validate_args=False)

    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        return self.gauge_about(anchor)(direction)

    def gauge_about(self, anchor: Tensor) -> Gauge:
        above, below = self.high - anchor, anchor - self.low
        return partial(_gauge, above.reciprocal(), below.reciprocal())

    def bounding_box(self) -> Bounds:
        return Bounds(self.low, self.high)

    def magnitude(self) -> Tensor:
        """Return the largest coordinate of any point, ``(*batch,)``."""
        if self._kept is not None:
            return self._kept.magnitude
        return torch.maximum(self.high, -self.low).amax(-1)

    def smallest_width(self) -> Tensor:
        """Return the width in the narrowest component, ``(*batch,)``."""
        if self._kept is not None:
            return self._kept.width
        return (self.high - self.low).amin(-1)

    def middle_and_half(self) -> tuple[Tensor, Tensor]:
        """Return the middles of all sides and half of their lengths, both ``(*batch, d)``."""
        if self._halves is not None:
            return self._halves
        return (self.low + self.high) / 2, (self.high - self.low) / 2

    def prepared(self) -> Self:
        """Return the box with what flows and anchors ask of action bounds computed once.

        For bounds that stay the same from state to state; they get no gradient.
        """
        box = type(self)(self.low.detach(), self.high.detach(), validate_args=False)
        magnitude = box.magnitude()
        eroded = box.eroded(magnitude)
        object.__setattr__(eroded, "_halves", eroded.middle_and_half())
        kept = _Kept(magnitude, box.smallest_width(), eroded, box.rounding(magnitude))
        object.__setattr__(box, "_kept", kept)
        return box

    def eroded(self, magnitude: Tensor | float = 1.0) -> Self:
        if self._kept is not None and magnitude is self._kept.magnitude:
            return self._kept.eroded
        eps, size = EROSION_IN_EPS * torch.finfo(self.dtype).eps, self._size(magnitude)
        low, high = torch.add(self.low, size, alpha=eps), torch.sub(self.high, size, alpha=eps)
        return type(self)(low, high, validate_args=False)

    def row_count(self) -> int:
        return 2 * self.dim

    def rounding(self, magnitude: Tensor | float = 1.0) -> Tensor:
        if self._kept is not None and magnitude is self._kept.magnitude:
            return self._kept.rounding
        moved = EROSION_IN_EPS * torch.finfo(self.dtype).eps * self._size(magnitude)
        return torch.cat([moved, moved], -1)

    def _size(self, magnitude: Tensor | float) -> Tensor:
        largest = torch.as_tensor(magnitude, dtype=self.dtype, device=self.low.device)
        return torch.minimum(torch.maximum(self.high, -self.low), largest.unsqueeze(-1))

    def around(self, center: Tensor, radius: Tensor) -> Self:
        half = radius.unsqueeze(-1)
        return type(self)(center - half, center + half, validate_args=False)

    def unless_dropped(self, active: Tensor, center: Tensor, radius: Tensor) -> Self:
        # Arithmetic, not torch.where, which is slow where the mask broadcasts. Where the set is
        # active the shift is so large that the bounds stay, wherever the center is.
        shift = active.to(self.dtype) * (torch.finfo(self.dtype).max / 2) - radius
        shift = shift.unsqueeze(-1)
        low = torch.minimum(self.low, center + shift)
        high = torch.maximum(self.high, center - shift)
        return type(self)(low, high, validate_args=False)

    def superlevel(self) -> Rows:
        identity = torch.eye(self.dim, dtype=self.dtype, device=self.low.device)
        low, high = torch.broadcast_tensors(self.low, self.high)
        offsets = torch.cat([high, -low], -1)
        return Rows(torch.cat([identity, -identity]), offsets, torch.ones_like(offsets))


def require_action_bounds(bounds: Box, where: str = "action bounds") -> Box:
    """Return the action bounds, stage 0 of every flow, or refuse them.

    Reads them on the host.

    Args:
        bounds: The box of all actions.
        where: The beginning of the message.

    Raises:
        GeometryError: when a bound is not finite, or bounds are closer to each other than rounding
            errors allow, or outside `ACTION_RANGE`.
    """
    bounds.validate_shapes(where)
    low, high = torch.broadcast_tensors(bounds.low, bounds.high)
    width, rounding = high - low, EROSION_IN_EPS * torch.finfo(bounds.dtype).eps
    least, most = ACTION_RANGE[bounds.dtype]
    for bad, expected in (
        (~(low.isfinite() & high.isfinite()), "finite bounds; use an open box as a constraint"),
        (low >= high, "low < high"),
        # Erosion takes twice the rounding error on both sides: half of the room must be left.
        (
            width < 8 * rounding * torch.maximum(low.abs(), high.abs()),
            f"bounds further apart than rounding error in {bounds.dtype}; shift them, or convert "
            "them to float64",
        ),
        (
            (width < least) | (torch.maximum(low.abs(), high.abs()) > most),
            f"bounds in {bounds.dtype} at least {least:g} apart and of at most {most:g}; scale the "
            "actions",
        ),
    ):
        if bool(bad.any()):
            index = tuple(bad.nonzero()[0].tolist())
            raise GeometryError(
                f"{where}: expected {expected}, given low {low[index].item()} and high "
                f"{high[index].item()} at index {list(index)}"
            )
    return bounds


def sides(offset: Tensor) -> tuple[Tensor, Tensor]:
    """Return the positive and the negative part of an offset, both ``(*batch, d)`` and >= 0."""
    # Not two maxima, whose gradients cost more than this one and the difference.
    ahead = offset.relu()
    return ahead, ahead - offset


def gauge_of_sides(above: Tensor, below: Tensor, ahead: Tensor, behind: Tensor) -> Tensor:
    """Return the gauge of a box, ``(*batch,)``, at an offset from an anchor given by its `sides`.

    Args:
        above: Inverse distances from the anchor to the high bounds, ``(*batch, d)``.
        below: Inverse distances from the anchor to the low bounds, ``(*batch, d)``.
        ahead: The positive part of the offset, ``(*batch, d)``.
        behind: The negative part of the offset, ``(*batch, d)``.
    """
    return torch.addcmul(ahead * above, behind, below).amax(-1)


def _gauge(above: Tensor, below: Tensor, direction: Tensor) -> Tensor:
    return gauge_of_sides(above, below, *sides(direction))
