"""Retractions that leave actions nearly as they are, except close to the boundary."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from cnfp_torchrl.bijectors.bijector import Bijector, Stages, stacked
from cnfp_torchrl.bijectors.exact_squash import ExactSquash, split
from cnfp_torchrl.geometry import (
    Box,
    ConstraintSet,
    Gauge,
    Region,
    gauge_of_sides,
    require_action_bounds,
    scaled_direction,
    sides,
)

SHARPNESS = 2.0
"""The default sharpness p. A larger one moves less, and saturates like the distance to the -p."""

MOST_SHARP = 100.0
"""The largest sharpness, beyond which rounding errors would be amplified out of the set."""


class SoftRetraction(Bijector):
    r"""Retract R^d, or a set in it, onto a region, leaving the interior of the region nearly alone.

    Let c be the region's anchor, :math:`v = x - c`, :math:`g_0` the gauge of the outer set, 0 for
    R^d, G the gauge of its intersection with the region, and p the sharpness. Then

    .. math:: a = c + v\, u^{-1/p}, \quad u = 1 + G(v)^p - g_0(v)^p, \quad
        \log|\det| = -(d/p + 1) \log u.

    Along each ray the slope is 1 at the anchor, and the end of the outer set becomes the end of the
    region. As :math:`p \to \infty` the map becomes the clip along rays (alpha projection). From R^d
    or a box, the bounds and boxes of the region retract each component by itself, by the same
    formula in one dimension; then the other sets retract along the ray.

    Far from the anchor the slope is as small as :math:`G(v)^{-p}`, below rounding error for many
    latents: they become the same action. So the inverse undoes the map as far as rounding lets it.
    Actions with :math:`G(a - c) \le 1 - 64 \epsilon s`, where :math:`\epsilon` is the dtype's and s
    is how many times the anchor's slack fits into the largest action, have a finite latent, which
    becomes the same action again. Beyond, the latent may be infinite or NaN, and `contains` is
    false; `well_inside` moves actions to where it is not. In float32 all is finite while
    :math:`G(v) < 10^{37}`.

    Args:
        region: Regions of batch shape ``(*batch,)``; they are eroded here. Their bounds may be
            infinite (`Region.with_finite_bounds`).
        outer: Convex sets that arguments lie in, not eroded here and bounded or not, with the
            anchor strictly inside; None is R^d.
        sharpness: The sharpness p, from 1 to `MOST_SHARP`.
        by_components: Whether boxes retract by components; never about an outer set that is no box.
        validate_args: Whether to check that bounds leave room in the dtype, which reads them.

    Raises:
        ValueError: when the sharpness is out of range.
        GeometryError: when finite action bounds are too narrow or too large for the dtype.
    """

    def __init__(
        self,
        region: Region,
        outer: ConstraintSet | None = None,
        *,
        sharpness: float = SHARPNESS,
        by_components: bool = True,
        validate_args: bool = True,
    ) -> None:
        super().__init__()
        region = region.with_finite_bounds()
        if validate_args:
            require_action_bounds(region.bounds)
        self.region = region.eroded()
        anchor = self.region.anchor
        self._sharpness = require_sharpness(sharpness)
        self._by_components = by_components and (outer is None or isinstance(outer, Box))
        self._outer: Box | Gauge | None
        if isinstance(outer, Box):
            self._outer = Box(outer.low - anchor, outer.high - anchor, validate_args=False)
        else:
            self._outer = None if outer is None else outer.gauge_about(anchor)
        self._core = self._into(self.region.sets)

    @property
    def shape(self) -> torch.Size:
        return self.region.shape

    def forward_and_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        offset = latent - self.region.anchor
        return self._core.forward_and_log_det(offset, torch.zeros_like(offset))

    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        offset, log_det = self._core.inverse_and_log_det(action)
        return self.region.anchor + offset, log_det

    def stages(self, latent: Tensor) -> Stages:
        offset, sets = latent - self.region.anchor, self.region.sets
        zeros = torch.zeros_like(offset)
        return stacked(
            self._into(sets[:count]).forward_and_log_det(offset, zeros)
            for count in range(1, len(sets) + 1)
        )

    def _into(self, sets: Sequence[ConstraintSet]) -> SoftContraction:
        boxes, others = split(sets, by_boxes=self._by_components)
        return SoftContraction(self._outer, boxes, others, self.region.anchor, self._sharpness)


class SoftSquash(ExactSquash):
    r"""Squash R^d exactly onto the intersection of all active sets, leaving its interior alone.

    The exact flow, but with `SoftRetraction` in the place of its retractions: a box squash into the
    action bounds, then boxes by components and other sets along rays. Where nothing binds the
    action is that of a tanh-squashed Gaussian, and near the anchor it nearly is everywhere: the
    density has a limit there, which that of `ExactSquash` has not.

    Args:
        region: Regions of batch shape ``(*batch,)``.
        sharpness: The sharpness p, from 1 to `MOST_SHARP`.
        by_components: Whether boxes retract by components, not along the ray.
        validate_args: Whether to check the action bounds, which reads them on the host.

    Raises:
        ValueError: when the sharpness is out of range.
        GeometryError: when the action bounds are invalid.
    """

    def __init__(
        self,
        region: Region,
        *,
        sharpness: float = SHARPNESS,
        by_components: bool = True,
        validate_args: bool = True,
    ) -> None:
        self._sharpness = require_sharpness(sharpness)
        self._by_components = by_components
        super().__init__(region, validate_args=validate_args)

    def _retraction_into(self, sets: Sequence[ConstraintSet]) -> SoftContraction:
        boxes, others = split(sets, by_boxes=self._by_components)
        anchor = self.region.anchor
        return SoftContraction(self._squash.image, boxes, others, anchor, self._sharpness)


class SoftContraction:
    """The soft retraction of offsets from an anchor onto actions.

    Args:
        outer: The outer set's box of offsets, or its gauge of offsets; None is R^d.
        boxes: Boxes that retract each component by itself; none if the outer set is a gauge.
        others: Sets that retract along the ray.
        anchor: Points strictly inside all sets, ``(*batch, d)``.
        sharpness: The sharpness p.
    """

    def __init__(
        self,
        outer: Box | Gauge | None,
        boxes: Sequence[Box],
        others: Sequence[ConstraintSet],
        anchor: Tensor,
        sharpness: float,
    ) -> None:
        self._anchor, self._sharpness = anchor, sharpness
        self._outer_sides: _Sides | None = None
        self._box_sides: _Sides | None = None
        self._outer_gauge: Gauge | None = None
        if isinstance(outer, Box):
            self._outer_sides = outer.high.reciprocal(), -outer.low.reciprocal()
            self._outer_gauge = _box_gauge(*self._outer_sides)
        else:
            self._outer_gauge = outer
        if boxes:
            low, high = boxes[0].low - anchor, boxes[0].high - anchor
            for box in boxes[1:]:
                low = torch.maximum(low, box.low - anchor)
                high = torch.minimum(high, box.high - anchor)
            if isinstance(outer, Box):
                low, high = torch.maximum(low, outer.low), torch.minimum(high, outer.high)
            self._box_sides = high.reciprocal(), -low.reciprocal()
            self._outer_gauge = _box_gauge(*self._box_sides)
        self._inner = [other.gauge_about(anchor) for other in others]

    def forward(self, offset: Tensor) -> Tensor:
        return self.forward_and_log_det(offset, torch.zeros_like(offset))[0]

    def forward_and_log_det(self, offset: Tensor, log_slopes: Tensor) -> tuple[Tensor, Tensor]:
        """Return the action and the log-determinant of the map from the latent to it.

        Args:
            offset: Offsets within the outer set, ``(*batch, d)``.
            log_slopes: Log-derivatives of the offset in the latent by component, ``(*batch, d)``.
        """
        p, log_det = self._sharpness, log_slopes.sum(-1)
        if self._box_sides is not None:
            factor, log_u = soft_factor(*self._by_component(offset), p)
            offset = offset * factor
            log_det = torch.sub(log_det, log_u.sum(-1), alpha=1 + 1 / p)
        if self._inner:
            factor, log_u = soft_factor(*self._along_ray(offset), p)
            offset = offset * factor.unsqueeze(-1)
            log_det = torch.sub(log_det, log_u, alpha=1 + offset.shape[-1] / p)
        return self._anchor + offset, log_det

    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return the offset of an action and the log-determinant of the map from it to that."""
        p, offset = self._sharpness, action - self._anchor
        log_det = torch.zeros_like(offset[..., 0])
        if self._inner:
            progress, gauge = self._along_ray(offset)
            factor, log_u = _inverse_soft_factor(progress, gauge, p)
            offset = offset * factor.unsqueeze(-1)
            log_det = torch.add(log_det, log_u, alpha=1 + offset.shape[-1] / p)
        if self._box_sides is not None:
            progress, gauge = self._by_component(offset)
            factor, log_u = _inverse_soft_factor(progress, gauge, p)
            offset = offset * factor
            log_det = torch.add(log_det, log_u.sum(-1), alpha=1 + 1 / p)
        return offset, log_det

    def _by_component(self, offset: Tensor) -> tuple[Tensor | None, Tensor]:
        """Return the gauges of outer and inner box in each component, each ``(*batch, d)``."""
        assert self._box_sides is not None
        ahead, behind = sides(offset)
        above, below = self._box_sides
        gauge = torch.addcmul(ahead * above, behind, below)
        if self._outer_sides is None:
            return None, gauge
        above, below = self._outer_sides
        return torch.addcmul(ahead * above, behind, below), gauge

    def _along_ray(self, offset: Tensor) -> tuple[Tensor | None, Tensor]:
        """Return the gauges of outer and inner set at an offset, each ``(*batch,)``."""
        # Gauges are taken of a direction of size one, because they square it. Its length has a
        # gradient in one dimension alone, where the direction has none.
        length = offset.detach().abs().amax(-1) if offset.shape[-1] > 1 else offset.abs()[..., 0]
        direction, _ = scaled_direction(offset)
        gauges = [gauge(direction) for gauge in self._inner]
        if self._outer_gauge is None:
            return None, length * torch.stack(torch.broadcast_tensors(*gauges)).amax(0)
        outer = self._outer_gauge(direction)
        largest = torch.stack(torch.broadcast_tensors(outer, *gauges)).amax(0)
        return length * outer, length * largest


def soft_factor(progress: Tensor | None, gauge: Tensor, sharpness: float) -> tuple[Tensor, Tensor]:
    r"""Return the factor :math:`u^{-1/p}` and :math:`\log u` of a soft retraction.

    With q the progress, G the gauge, :math:`m = \min(G, 1)` and :math:`M = \max(G, 1)`,
    :math:`u = M^p (1 + e)` with :math:`e = (m^p - q^p) / M^p`. No power is above 1, so that none
    overflows; e is 0 exactly where no inner set binds; and at the end of the outer set the factor
    is that of a division by G, to a few rounding errors, whatever p is.

    Args:
        progress: The gauge of the outer set, at most 1 up to rounding error; None is 0.
        gauge: The gauge of the inner set, at least as large as the progress.
        sharpness: The sharpness p.
    """
    one = torch.ones_like(gauge)
    below, above = torch.minimum(gauge, one), torch.maximum(gauge, one)
    excess = below.pow(sharpness)
    if progress is not None:
        excess = excess - progress.pow(sharpness)
    log_excess = (excess * above.pow(-sharpness)).log1p()
    factor = (log_excess / -sharpness).exp() / above
    return factor, torch.add(log_excess, above.log(), alpha=sharpness)


def _inverse_soft_factor(
    progress: Tensor | None, gauge: Tensor, sharpness: float
) -> tuple[Tensor, Tensor]:
    """Return the factor that undoes `soft_factor`, and log u; NaN where nothing does."""
    used = gauge.pow(sharpness)
    if progress is not None:
        used = used - progress.pow(sharpness)
    log_u = -used.neg().log1p()
    factor = (log_u / sharpness).exp()
    if progress is not None:
        # Rays that would leave the outer set have no argument.
        factor = torch.where(progress * factor < 1, factor, torch.nan)
    return factor, log_u


def require_sharpness(sharpness: float) -> float:
    """Return a sharpness from 1 to `MOST_SHARP`, or refuse it.

    Raises:
        ValueError: when it is out of range.
    """
    if not 1 <= sharpness <= MOST_SHARP:
        raise ValueError(
            f"sharpness: expected a number from 1 to {MOST_SHARP:g}, given {sharpness}"
        )
    return float(sharpness)


_Sides = tuple[Tensor, Tensor]


def _box_gauge(above: Tensor, below: Tensor) -> Gauge:
    return lambda direction: gauge_of_sides(above, below, *sides(direction))
