"""Families that are wrong in one way each, and the method that the checker has to name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import torch
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.geometry import Ball, Bounds, Cone, ConstraintSet, Gauge, Rows, VisibleRegion


class PlainBall(Ball):
    """A ball of which each method is its own, so that a broken one breaks nothing else."""

    def gauge_about(self, anchor: Tensor) -> Gauge:
        return lambda direction: self.gauge(direction, anchor)

    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        return Ball(self.center, self.radius, validate_args=False).gauge(direction, anchor)

    def superlevel(self) -> Any:
        return None

    unless_dropped = ConstraintSet.unless_dropped


class InflatedByAShare(PlainBall):
    """Relative where it should be absolute."""

    def inflated(self, by: Tensor) -> Self:
        return type(self)(self.center, self.radius * (1 + by.squeeze(-1)), validate_args=False)


class RowsDeeperThanTheSet(PlainBall):
    def row_slacks(self, action: Tensor) -> Tensor:
        return 2 * super().row_slacks(action)


class GaugeOfTheWrongSign(PlainBall):
    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        return super().gauge(-direction, anchor)


class GaugeAboutTheMiddle(PlainBall):
    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        return vector_norm(direction, dim=-1) / self.radius


class CancelingGauge(PlainBall):
    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        w = anchor - self.center
        b, k = (direction * w).sum(-1), self.radius**2 - (w * w).sum(-1)
        return (b + (b * b + (direction * direction).sum(-1) * k).sqrt()) / k


class CancelingOnTheWayBack(PlainBall):
    """It subtracts where the direction leads away from the boundary only."""

    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        w = anchor - self.center
        distance = vector_norm(w, dim=-1)
        k = (self.radius - distance) * (self.radius + distance)
        b = (direction * w).sum(-1)
        return (b + (b * b + (direction * direction).sum(-1) * k).sqrt()) / k


class GaugeThatIsNotHomogeneous(PlainBall):
    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        return super().gauge(direction, anchor) + 1e-9


class GaugeOfFourthPowers(PlainBall):
    """Right, but the powers of short directions are no numbers that float32 has."""

    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        length = direction.pow(4).sum(-1).pow(0.25)
        return super().gauge(direction / length.unsqueeze(-1), anchor) * length


class GaugeWithNanAtKinks(PlainBall):
    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        # Zero, but for the gradient.
        length = (direction * direction).sqrt().sum(-1)
        return super().gauge(direction, anchor) + 0 * length


class GaugeWithoutGradient(PlainBall):
    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        return super().gauge(direction.detach(), anchor) + 0 * direction.sum(-1)


class GaugeThatMixesTheBatch(PlainBall):
    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        return direction.norm(dim=-1) / (self.radius - (anchor - self.center).norm()).min()


class GaugeOfTheWrongShape(PlainBall):
    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        return super().gauge(direction, anchor).unsqueeze(-1)


class GaugeThatRaises(PlainBall):
    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        return direction @ anchor


class GaugeAboutOfAnotherAnchor(PlainBall):
    def gauge_about(self, anchor: Tensor) -> Gauge:
        return lambda direction: self.gauge(direction, self.center)


class NoErosion(PlainBall):
    def eroded(self, magnitude: Tensor | float = 1.0) -> Self:
        return self


class ErosionOfTheRadiusAlone(PlainBall):
    """Not of the anchor, which may be the larger number."""

    def eroded(self, magnitude: Tensor | float = 1.0) -> Self:
        eps = torch.finfo(self.dtype).eps
        return type(self)(self.center, self.radius * (1 - eps), validate_args=False)


class ErosionByAShare(PlainBall):
    def eroded(self, magnitude: Tensor | float = 1.0) -> Self:
        return type(self)(self.center, self.radius * (1 - 1e-4), validate_args=False)


class ErosionToAnotherShape(PlainBall):
    def eroded(self, magnitude: Tensor | float = 1.0) -> Self:
        return type(self)(self.center, self.radius.unsqueeze(-1), validate_args=False)


class SlackThatIsNotConcave(PlainBall):
    def slack(self, action: Tensor) -> Tensor:
        distance = vector_norm(action - self.center, dim=-1)
        return (self.radius - distance) / (1 + distance)


class SlackBeyondTheDistance(PlainBall):
    def slack(self, action: Tensor) -> Tensor:
        return 2 * super().slack(action)


class SlackOfTheWrongShape(PlainBall):
    def slack(self, action: Tensor) -> Tensor:
        return super().slack(action).unsqueeze(-1)


class SlackWithoutGradient(PlainBall):
    def slack(self, action: Tensor) -> Tensor:
        return super().slack(action.detach()) + 0 * action.sum(-1)


class SlackWithNan(PlainBall):
    def slack(self, action: Tensor) -> Tensor:
        return self.radius - vector_norm(action - self.center, dim=-1).sub(self.radius).sqrt()


class ContainsInItsOwnDtype(PlainBall):
    def contains(self, action: Tensor) -> Tensor:
        return vector_norm(action - self.center, dim=-1) <= self.radius


class ContainsTheOpenOutside(PlainBall):
    def contains(self, action: Tensor) -> Tensor:
        return vector_norm(action.double() - self.center, dim=-1) <= 1.1 * self.radius


class AroundTooSmall(PlainBall):
    def around(self, center: Tensor, radius: Tensor) -> Self:
        return super().around(center, 0.9 * radius)


class AroundTooSmallIfLarge(PlainBall):
    def around(self, center: Tensor, radius: Tensor) -> Self:
        return super().around(center, torch.where(self.radius > 1.9, 0.9, 1.0) * radius)


class AroundItself(PlainBall):
    def around(self, center: Tensor, radius: Tensor) -> Self:
        return type(self)(self.center, self.radius + radius, validate_args=False)


class AroundOfAnotherShape(PlainBall):
    def around(self, center: Tensor, radius: Tensor) -> Self:
        return type(self)(center, radius.unsqueeze(-1), validate_args=False)


class AroundNotWritten(PlainBall):
    def around(self, center: Tensor, radius: Tensor) -> Self:
        raise NotImplementedError("around")


class DroppedByInfinity(PlainBall):
    """Infinite radii do not bind, but their gradients are no numbers."""

    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        # Adds nothing, but the gradient of a root at 0, which infinite radii bring about.
        scaled = direction / self.radius.unsqueeze(-1)
        return super().gauge(direction, anchor) + 0 * (scaled * scaled).sum(-1).sqrt()

    def unless_dropped(self, active: Tensor, center: Tensor, radius: Tensor) -> Self:
        wide = torch.where(active, self.radius, torch.inf)
        return type(self)(self.center, wide, validate_args=False)


class SmallBoundingBox(PlainBall):
    def bounding_box(self) -> Bounds:
        half = 0.99 * self.radius.unsqueeze(-1)
        return Bounds(self.center - half, self.center + half)


class DeepestInTheMiddle(PlainBall):
    def deepest_within(self, box: Bounds) -> Tensor:
        return (box.low + box.high) / 2


class DeepestOutside(PlainBall):
    def deepest_within(self, box: Bounds) -> Tensor:
        return self.center


class SuperlevelElsewhere(PlainBall):
    def superlevel(self) -> Cone:
        cone = Ball.superlevel(self)
        return Cone(cone.matrix, -cone.vector, cone.size, cone.rate)


class SuperlevelOfAPart(PlainBall):
    """Sound, but then a set is dropped that holds."""

    def superlevel(self) -> Cone:
        cone = Ball.superlevel(self)
        return Cone(cone.matrix, cone.vector, 0.5 * cone.size, cone.rate)


class PartThatIgnoresThePoint(VisibleRegion):
    def part_near(self, point: Tensor) -> Rows:
        return super().part_near(torch.zeros_like(self.position))


class ViolationsOfTheExample(PlainBall):
    def invalid_fields(self) -> Iterator[tuple[str, Tensor, str]]:
        yield "radius", self.radius > 0, "a negative radius"


class ViolationsOfNoField(PlainBall):
    def invalid_fields(self) -> Iterator[tuple[str, Tensor, str]]:
        yield "size", self.radius <= 0, "a size > 0"


class EventDimsOfTheRadius(PlainBall):
    event_dims: ClassVar[Mapping[str, int]] = {"center": 1, "radius": 1}


class EventDimsOfTheAnchor(PlainBall):
    event_dims: ClassVar[Mapping[str, int]] = {"center": 0, "radius": 0}


class EventDimsAsATuple(PlainBall):
    event_dims: ClassVar[Any] = (1, 0)


class EventDimsOfOtherFields(PlainBall):
    event_dims: ClassVar[Mapping[str, int]] = {"center": 1, "size": 0}


@dataclass(frozen=True, eq=False)
class NoEventDims(ConstraintSet):
    center: Tensor
    radius: Tensor

    slack = Ball.slack  # type: ignore[assignment]
    gauge = Ball.gauge  # type: ignore[assignment]
    eroded = Ball.eroded  # type: ignore[assignment]
    around = Ball.around  # type: ignore[assignment]


BROKEN: list[tuple[type[ConstraintSet], str]] = [
    (GaugeOfTheWrongSign, "gauge"),
    (GaugeAboutTheMiddle, "gauge"),
    (CancelingGauge, "gauge"),
    (CancelingOnTheWayBack, "gauge"),
    (GaugeThatIsNotHomogeneous, "gauge"),
    (GaugeOfFourthPowers, "gauge"),
    (GaugeWithNanAtKinks, "gauge"),
    (GaugeWithoutGradient, "gauge"),
    (GaugeThatMixesTheBatch, "gauge"),
    (GaugeOfTheWrongShape, "gauge"),
    (GaugeThatRaises, "gauge"),
    (GaugeAboutOfAnotherAnchor, "gauge_about"),
    (NoErosion, "eroded"),
    (ErosionOfTheRadiusAlone, "eroded"),
    (ErosionByAShare, "eroded"),
    (ErosionToAnotherShape, "eroded"),
    (SlackThatIsNotConcave, "slack"),
    (SlackBeyondTheDistance, "slack"),
    (SlackOfTheWrongShape, "slack"),
    (SlackWithoutGradient, "slack"),
    (SlackWithNan, "slack"),
    (ContainsInItsOwnDtype, "contains"),
    (ContainsTheOpenOutside, "contains"),
    (AroundTooSmall, "around"),
    (AroundItself, "around"),
    (AroundOfAnotherShape, "around"),
    (AroundNotWritten, "around"),
    (DroppedByInfinity, "unless_dropped"),
    (SmallBoundingBox, "bounding_box"),
    (DeepestInTheMiddle, "deepest_within"),
    (DeepestOutside, "deepest_within"),
    (SuperlevelElsewhere, "superlevel"),
    (SuperlevelOfAPart, "superlevel"),
    (InflatedByAShare, "inflated"),
    (RowsDeeperThanTheSet, "row_slacks"),
    (ViolationsOfTheExample, "invalid_fields"),
    (ViolationsOfNoField, "invalid_fields"),
    (EventDimsOfTheRadius, "event_dims"),
    (EventDimsOfTheAnchor, "event_dims"),
    (EventDimsAsATuple, "event_dims"),
    (EventDimsOfOtherFields, "event_dims"),
    (NoEventDims, "event_dims"),
]
