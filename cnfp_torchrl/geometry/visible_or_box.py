"""The visible region, with a box in its place where a point has no room to look around."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import torch
from torch import Tensor

from cnfp_torchrl.geometry.box import Box
from cnfp_torchrl.geometry.constraint_set import ConstraintSet
from cnfp_torchrl.geometry.superlevel import Rows
from cnfp_torchrl.geometry.visible_region import VisibleRegion


@dataclass(frozen=True, eq=False)
class VisibleOrBox(ConstraintSet):
    r"""The visible region where `in_sight` is 1, a box of actions where it is 0.

    A visible region always contains the zero action or nothing. Where rounding has brought a point
    a hair inside the margin around an obstacle, the action must lead away from it, and a box that
    leaves out 0 can say so.

    Args:
        position: see `VisibleRegion`.
        rectangles: see `VisibleRegion`.
        step: see `VisibleRegion`.
        low: lower bounds of the box, ``(*batch, d)``.
        high: upper bounds of the box, ``(*batch, d)``.
        in_sight: 1 or 0, ``(*batch,)``.
    """

    position: Tensor
    rectangles: Tensor
    step: Tensor
    low: Tensor
    high: Tensor
    in_sight: Tensor

    event_dims: ClassVar[Mapping[str, int]] = {
        **VisibleRegion.event_dims,
        **Box.event_dims,
        "in_sight": 0,
    }

    @property
    def region(self) -> VisibleRegion:
        """The visible region, also where it does not count."""
        return VisibleRegion(self.position, self.rectangles, self.step, validate_args=False)

    @property
    def box(self) -> Box:
        """The box, also where it does not count."""
        return Box(self.low, self.high, validate_args=False)

    @property
    def sees(self) -> Tensor:
        """Where the visible region counts, boolean ``(*batch,)``."""
        return self.in_sight > 0

    def invalid_fields(self) -> Iterator[tuple[str, Tensor, str]]:
        yield from self.region.invalid_fields()
        yield from self.box.invalid_fields()
        yield "in_sight", (self.in_sight != 0) & (self.in_sight != 1), "0 or 1"

    def shape_problem(self) -> str | None:
        return self.region.shape_problem()

    def contains(self, action: Tensor) -> Tensor:
        return torch.where(self.sees, self.region.contains(action), self.box.contains(action))

    def slack(self, action: Tensor) -> Tensor:
        return torch.where(self.sees, self.region.slack(action), self.box.slack(action))

    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        # Each is replaced where it does not count: its gauge about an anchor outside of it may be
        # NaN, and so would the gradient be, even where it is masked.
        one = torch.ones_like(self.in_sight)
        region = self.region.unless_dropped(self.sees, anchor, one)
        box = self.box.unless_dropped(~self.sees, anchor, one)
        return torch.where(self.sees, region.gauge(direction, anchor), box.gauge(direction, anchor))

    def bounding_box(self) -> Box:
        return self.region.bounding_box().where(self.sees, self.box)

    def eroded(self, magnitude: Tensor | float = 1.0) -> Self:
        fields = {**self.region.eroded(magnitude).fields(), **self.box.eroded(magnitude).fields()}
        return type(self)(**fields, in_sight=self.in_sight, validate_args=False)

    def around(self, center: Tensor, radius: Tensor) -> Self:
        parts = (self.region.around(center, radius), self.box.around(center, radius))
        fields = {name: value for part in parts for name, value in part.fields().items()}
        return type(self)(**fields, in_sight=torch.zeros_like(self.in_sight), validate_args=False)

    def superlevel(self) -> Rows:
        """Describe a convex part, see `VisibleRegion.superlevel`, or the box."""
        return self.part_near(torch.zeros_like(self.position))

    def part_near(self, point: Tensor) -> Rows:
        """Describe a convex part, see `VisibleRegion.part_near`, or the box."""
        parts = (self.region.part_near(point), self.box.superlevel())
        counts = (self.sees.unsqueeze(-1), ~self.sees.unsqueeze(-1))
        offsets = [
            torch.where(on, p.offsets, torch.inf) for p, on in zip(parts, counts, strict=True)
        ]
        shape = torch.broadcast_shapes(*(offset.shape[:-1] for offset in offsets))
        return Rows(
            torch.cat([p.normals.expand(*shape, *p.normals.shape[-2:]) for p in parts], -2),
            torch.cat([each.expand(*shape, each.shape[-1]) for each in offsets], -1),
            torch.cat([p.rates.expand(*shape, p.rates.shape[-1]) for p in parts], -1),
        )
