"""A tanh squash into the action bounds, then retractions into a region: what exact flows share."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor

from cnfp_torchrl.bijectors.bijector import Bijector, Stages
from cnfp_torchrl.bijectors.box_squash import BoxSquash
from cnfp_torchrl.bijectors.component_scale import ComponentScale
from cnfp_torchrl.bijectors.rays import Rays, region_shape
from cnfp_torchrl.geometry import Box, ConstraintSet, Region
from cnfp_torchrl.geometry.box import gauge_of_sides, sides


class RegionSquash(Bijector):
    """Squash R^d exactly onto the intersection of all active sets of a region.

    A subclass says which of the sets are retracted component by component; the others are retracted
    along rays from the anchor. The image is the region eroded by rounding error: saturated samples
    satisfy every active constraint with zero tolerance.

    Args:
        region: sets, anchor and active flags, ``(*batch,)`` of them.
        validate_args: check the action bounds, which reads them on the host.

    Raises:
        GeometryError: when the action bounds are invalid.
    """

    def __init__(self, region: Region, *, validate_args: bool = True) -> None:
        super().__init__()
        if validate_args:
            region.bounds.validate()
        self.region = region.eroded()
        # All stages work in coordinates about the anchor, where the box squash and the gauges have
        # the same bounds in floating point. Were they a rounding error of the coordinates apart, a
        # gauge of 1 + e at the bounds would let samples overshoot by e times the distance to the
        # anchor, and near a bound one rounding error is a large e.
        self._box = BoxSquash.onto(self.region.bounds, validate_args=validate_args).about(
            region.anchor
        )
        self._retraction = self._retraction_into(self.region.sets[1:])

    @staticmethod
    @abstractmethod
    def boxes_and_others(
        sets: Sequence[ConstraintSet],
    ) -> tuple[Sequence[Box], Sequence[ConstraintSet]]:
        """Split constraints into boxes to retract component by component, and all others."""

    @property
    def shape(self) -> torch.Size:
        return region_shape(self.region)

    def forward_and_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        return self._retraction.forward_and_log_det(*self._box.forward_and_log_slopes(latent))

    def forward_and_reference_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        offset, log_det = self._box.forward_and_log_det(latent)
        return self._retraction.forward(offset), log_det

    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        offset, log_det = self._retraction.inverse_and_log_det(action)
        latent, box_log_det = self._box.inverse_and_log_det(offset)
        return latent, log_det + box_log_det

    def stages(self, latent: Tensor) -> Stages:
        offset, log_slopes = self._box.forward_and_log_slopes(latent)
        sets = self.region.sets
        # Each stage is the flow of the constraints so far.
        stages = [
            self._retraction_into(sets[1:stage]).forward_and_log_det(offset, log_slopes)
            for stage in range(1, len(sets) + 1)
        ]
        actions, log_dets = zip(*stages, strict=True)
        return Stages(
            torch.stack(torch.broadcast_tensors(*actions)),
            torch.stack(torch.broadcast_tensors(*log_dets)),
        )

    def _retraction_into(self, sets: Sequence[ConstraintSet]) -> _Retraction:
        boxes, others = self.boxes_and_others(sets)
        return _Retraction(self._box.image, boxes, others, self.region.anchor)


class _Retraction:
    """The bijection from offsets within the action bounds onto actions within further sets."""

    def __init__(
        self, bounds: Box, boxes: Sequence[Box], others: Sequence[ConstraintSet], anchor: Tensor
    ) -> None:
        self._anchor = anchor
        self._above, self._below = bounds.high.reciprocal(), -bounds.low.reciprocal()
        self._scale = None
        if boxes:
            inner = bounds
            for box in boxes:
                low = torch.maximum(inner.low, box.low - anchor)
                high = torch.minimum(inner.high, box.high - anchor)
                inner = Box(low, high, validate_args=False)
            self._scale = ComponentScale.between(bounds, inner)
        self._inner = [each.gauge_about(anchor) for each in others]

    def forward(self, offset: Tensor) -> Tensor:
        scaled, contraction = self._scaled_and_contraction(offset)
        return self._contracted(scaled, contraction)

    def forward_and_log_det(self, offset: Tensor, log_slopes: Tensor) -> tuple[Tensor, Tensor]:
        """Return the action and the log-determinant from the latent on.

        Args:
            offset: within the action bounds, ``(*batch, d)``.
            log_slopes: log-derivatives of its components in the latent's, ``(*batch, d)``.
        """
        scaled, contraction = self._scaled_and_contraction(offset)
        if self._scale is not None:
            log_slopes = log_slopes + self._scale.log_slopes(offset)
        log_det = log_slopes.sum(-1)
        if contraction is not None:
            log_det = torch.sub(log_det, contraction.log(), alpha=offset.shape[-1])
        return self._contracted(scaled, contraction), log_det

    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return the offset of an action, and the log-determinant of the way back to it."""
        offset = action - self._anchor
        if self._scale is not None:
            offset = self._scale.inverse(offset)
        # It depends on the direction alone, as the component scale does.
        _, contraction = self._scaled_and_contraction(offset)
        log_det = torch.zeros_like(offset[..., 0])
        if contraction is not None:
            offset = offset * contraction.unsqueeze(-1)
            log_det = offset.shape[-1] * contraction.log()
        if self._scale is not None:
            log_det = log_det - self._scale.log_slopes(offset).sum(-1)
        return offset, log_det

    def _scaled_and_contraction(self, offset: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return the offset after the boxes, and by what it is to be divided for other sets."""
        ahead, behind = sides(offset)
        scaled = offset if self._scale is None else self._scale.forward(ahead, behind)
        if not self._inner:
            return scaled, None
        progress = gauge_of_sides(self._above, self._below, ahead, behind)
        return scaled, Rays(scaled, progress).contraction(self._inner)

    def _contracted(self, scaled: Tensor, contraction: Tensor | None) -> Tensor:
        if contraction is None:
            return self._anchor + scaled
        # Not a quotient: its gradient takes more passes.
        return torch.addcmul(self._anchor, scaled, contraction.reciprocal().unsqueeze(-1))
