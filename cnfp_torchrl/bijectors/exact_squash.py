"""The exact flows: a tanh squash into the action bounds, then retractions into the allowed region.

The retractions are a bijective form of alpha projection (Sanket et al. 2020, "Solving online threat
screening games using constrained action space reinforcement learning"), which scales an action
towards an interior point until it is allowed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Protocol

import torch
from torch import Tensor
from torch.nn.functional import threshold

from cnfp_torchrl.bijectors.bijector import Bijector, Stages, stacked
from cnfp_torchrl.bijectors.squashes import BoxSquash
from cnfp_torchrl.geometry import (
    Box,
    ConstraintSet,
    Gauge,
    Region,
    component_sum,
    require_action_bounds,
)


class ExactSquash(Bijector):
    r"""Squash R^d exactly onto the intersection of all active sets of a region.

    Stage 0 is the box squash into the action bounds B, :math:`x = \mathrm{BoxSquash}(z)`. Let c be
    the anchor, :math:`v = x - c`, and :math:`B_k` the intersection of B with the boxes among the
    first k constraints. Boxes scale each component by itself,

    .. math:: w_i = v_i\, \rho_i, \quad \rho_i = room_i(B_k) / room_i(B),

    with :math:`room_i` the distance from c to the side that :math:`v_i` points to. The other sets
    scale along the ray, :math:`a_k = c + w/r`, :math:`r = G_k(w)/g_{B_k}(w)`, with :math:`G_k` the
    gauge (Minkowski functional) of their intersection with :math:`B_k`. At the last stage
    :math:`\log|\det| = \log|\det \mathrm{BoxSquash}| + \sum_i \log \rho_i - d \log r`.

    A box beside the agent thus shortens the motion towards it and leaves the motion along it as it
    is; a retraction of the whole vector (`GaugeSquash`) shortens both. Without boxes among the
    constraints the two flows are the same. The log-density jumps where a component of v changes its
    sign, and where other sets bind it has no limit at the anchor (`docs/method.md`). The image is
    the region eroded by rounding error, so that saturated samples satisfy every active constraint
    with zero tolerance.

    Args:
        region: Regions of batch shape ``(*batch,)``.
        validate_args: Whether to check the action bounds, which reads them on the host.

    Raises:
        GeometryError: when the action bounds are invalid.
    """

    scales_by_boxes: ClassVar[bool] = True
    """Whether boxes scale component by component, not along the ray as other sets do."""

    def __init__(self, region: Region, *, validate_args: bool = True) -> None:
        super().__init__()
        if validate_args:
            require_action_bounds(region.bounds)
        self.region = region.eroded()
        # All stages use coordinates about the anchor, not absolute ones, so that the box squash and
        # the gauges have the same bounds in floating point. Were those a rounding error apart, a
        # gauge of 1 + e at the bounds would let samples overshoot by e times the distance to the
        # anchor, and about an anchor near a bound one rounding error is a large e.
        self._squash = BoxSquash.onto(self.region.bounds).about(region.anchor)
        self._retraction = self._retraction_into(self.region.sets[1:])

    @property
    def shape(self) -> torch.Size:
        return self.region.shape

    def forward_and_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        return self._retraction.forward_and_log_det(*self._squash.forward_and_log_slopes(latent))

    def forward_and_reference_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        offset, log_det = self._squash.forward_and_log_det(latent)
        return self._retraction.forward(offset), log_det

    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        offset, log_det = self._retraction.inverse_and_log_det(action)
        latent, squash_log_det = self._squash.inverse_and_log_det(offset)
        return latent, log_det + squash_log_det

    def stages(self, latent: Tensor) -> Stages:
        offset, log_slopes = self._squash.forward_and_log_slopes(latent)
        sets = self.region.sets
        # Flows of the first constraints, not one flow cut open: later boxes rescale earlier stages.
        return stacked(
            self._retraction_into(sets[1:stage]).forward_and_log_det(offset, log_slopes)
            for stage in range(1, len(sets) + 1)
        )

    def _retraction_into(self, sets: Sequence[ConstraintSet]) -> OffsetRetraction:
        boxes, others = split(sets, by_boxes=self.scales_by_boxes)
        return _Retraction(self._squash.image, boxes, others, self.region.anchor)


class GaugeSquash(ExactSquash):
    r"""Squash R^d exactly onto the intersection of all active sets of a region, along rays.

    The exact flow, but with boxes retracted along the ray like all other sets. With :math:`v = x -
    c` from stage 0, :math:`g_0` the gauge of the bounds and :math:`G_k` that of the region after k
    constraints, :math:`a_k = c + v/r`, :math:`r = G_k(v)/g_0(v)`. At the last stage
    :math:`\log|\det| = \log|\det \mathrm{BoxSquash}| - d \log r`.

    Where nothing binds, r = 1 and the action is that of a tanh-squashed Gaussian. The log-density
    has no limit at the anchor, where its gradient grows like :math:`1/|v|` (`docs/method.md`). The
    arguments are those of `ExactSquash`.
    """

    scales_by_boxes = False


class OffsetRetraction(Protocol):
    """A bijection from offsets within the action bounds onto actions within further sets."""

    def forward(self, offset: Tensor) -> Tensor:
        """Return the action of an offset."""

    def forward_and_log_det(self, offset: Tensor, log_slopes: Tensor) -> tuple[Tensor, Tensor]:
        """Return the action and the log-determinant of the map from the latent to it."""

    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return the offset of an action and the log-determinant of the map from it to that."""


class _Retraction:
    """The bijection from offsets within the action bounds onto actions within further sets."""

    def __init__(
        self, bounds: Box, boxes: Sequence[Box], others: Sequence[ConstraintSet], anchor: Tensor
    ) -> None:
        self._anchor, self._high, self._low = anchor, bounds.high, bounds.low
        # The factors of positive and of negative components.
        self._above: Tensor | None = None
        self._below: Tensor | None = None
        if boxes:
            low, high = bounds.low, bounds.high
            for box in boxes:
                low = torch.maximum(low, box.low - anchor)
                high = torch.minimum(high, box.high - anchor)
            self._above, self._below = high / bounds.high, low / bounds.low
        self._inner = [other.gauge_about(anchor) for other in others]

    def forward(self, offset: Tensor) -> Tensor:
        scaled, contraction, _ = self._scaled_and_contraction(offset)
        return self._contracted(scaled, contraction)

    def forward_and_log_det(self, offset: Tensor, log_slopes: Tensor) -> tuple[Tensor, Tensor]:
        """Return the action and the log-determinant of the map from the latent to it.

        Args:
            offset: Offsets within the action bounds, ``(*batch, d)``.
            log_slopes: Log-derivatives of the offset in the latent by component, ``(*batch, d)``.
        """
        scaled, contraction, factors = self._scaled_and_contraction(offset)
        if factors is not None:
            log_slopes = log_slopes + factors.log()
        log_det = component_sum(log_slopes)
        if contraction is not None:
            log_det = torch.sub(log_det, contraction.log(), alpha=offset.shape[-1])
        return self._contracted(scaled, contraction), log_det

    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return the offset of an action and the log-determinant of the map from it to that."""
        offset = action - self._anchor
        if (factors := self._factors(self._ahead(offset))) is not None:
            offset = offset / factors
        # The divisor of the result is that of the offset: it depends on the direction alone.
        _, contraction, _ = self._scaled_and_contraction(offset)
        log_det = torch.zeros_like(offset[..., 0])
        if contraction is not None:
            offset = offset * contraction.unsqueeze(-1)
            log_det = offset.shape[-1] * contraction.log()
        if factors is not None:
            # In the dtype of latents, which may be finer than that of the sets.
            log_det = log_det - factors.log().sum(-1, dtype=offset.dtype)
        return offset, log_det

    def _scaled_and_contraction(
        self, offset: Tensor
    ) -> tuple[Tensor, Tensor | None, Tensor | None]:
        """Return the offset scaled by the boxes, the divisor r of the other sets, the factors."""
        ahead = self._ahead(offset)
        factors = self._factors(ahead)
        scaled = offset if factors is None else offset * factors
        if not self._inner:
            return scaled, None, factors
        outer_gauge = (offset / torch.lerp(self._low, self._high, ahead)).amax(-1)
        return scaled, contraction_along_rays(scaled, outer_gauge, self._inner), factors

    def _ahead(self, offset: Tensor) -> Tensor:
        """Return 1 for positive components and 0 for others, without a gradient.

        With these weights `torch.lerp` selects exactly, and in a tenth of the time of `torch.where`
        at large batches, where the processor cannot predict the branches. In the dtype of the sets,
        which may be coarser than that of latents.
        """
        return offset.detach().sign().relu().to(self._anchor.dtype)

    def _factors(self, ahead: Tensor) -> Tensor | None:
        r"""Return :math:`\rho_i`, ``(*batch, d)``, by the sides that components point to."""
        if self._above is None or self._below is None:
            return None
        return torch.lerp(self._below, self._above, ahead)

    def _contracted(self, scaled: Tensor, contraction: Tensor | None) -> Tensor:
        if contraction is None:
            return self._anchor + scaled
        # Not a quotient, whose gradient takes more passes.
        return torch.addcmul(self._anchor, scaled, contraction.reciprocal().unsqueeze(-1))


def split(
    sets: Sequence[ConstraintSet], *, by_boxes: bool
) -> tuple[list[Box], list[ConstraintSet]]:
    """Return the boxes among some sets, if they retract by components, and the other sets."""
    boxes = [
        constraint_set for constraint_set in sets if by_boxes and isinstance(constraint_set, Box)
    ]
    return boxes, [
        constraint_set
        for constraint_set in sets
        if not (by_boxes and isinstance(constraint_set, Box))
    ]


def contraction_along_rays(offset: Tensor, outer_gauge: Tensor, inner: Sequence[Gauge]) -> Tensor:
    r"""Return the divisor r that retracts offsets of an outer set into inner ones, ``(*batch,)``.

    :math:`r = \max(1, \max_j g_j(v)/g_{outer}(v))`, and 1 for an offset of zero. Where no inner set
    binds it is exactly 1, and its gradient 0. An inner gauge of NaN makes it NaN: a broken
    constraint must not pass for one that does not bind.

    Args:
        offset: Points of the outer set minus the anchor, v, ``(*batch, d)``.
        outer_gauge: The gauge of the outer set at the offset, ``(*batch,)``.
        inner: Gauges of one or more inner sets about the anchor.
    """
    # In one dimension a direction is a sign, without a gradient. The exact zero would be computed
    # as rounding error over length.
    if offset.shape[-1] == 1:
        offset, outer_gauge = offset.detach(), outer_gauge.detach()
    # An offset of zero has no direction. It gets an arbitrary one, so that nothing becomes NaN, and
    # an outer gauge with which no set binds. So do offsets so short that gradients, which grow like
    # 1/length, could overflow when squared.
    shortest = torch.finfo(offset.dtype).tiny ** 0.4
    direction = offset + (outer_gauge <= shortest).unsqueeze(-1)
    gauges = [gauge(direction) for gauge in inner]
    if len(gauges) == 1:
        largest = gauges[0]
    else:
        # Not one maximum after the other, each of whose gradients costs as much as this one's.
        largest = torch.stack(torch.broadcast_tensors(*gauges)).amax(0)
    # The maximum of the ratio and 1; not clamp, whose gradient takes more passes.
    return threshold(largest / threshold(outer_gauge, shortest, torch.inf), 1, 1)
