"""The exact flow: a tanh squash into the action bounds, then radial retractions into the region."""

from __future__ import annotations

import torch
from torch import Tensor

from cnfp_torchrl.bijectors.bijector import Bijector, Stages
from cnfp_torchrl.bijectors.box_squash import BoxSquash
from cnfp_torchrl.bijectors.rays import region_shape, scale_about, scaled_direction, share_of
from cnfp_torchrl.geometry import Region


class GaugeSquash(Bijector):
    r"""Squash R^d exactly onto the intersection of all active sets of a region.

    Stage 0 is the box squash into the action bounds, :math:`x = \mathrm{BoxSquash}(z)`. Each
    further stage retracts radially about the centre c: with :math:`v = x - c`, :math:`g_0` the
    gauge of the bounds and :math:`G_k` that of the region after k constraints,
    :math:`a_k = c + v\, g_0(v)/G_k(v)`. With :math:`s = g_0/G_K` of the last stage,
    :math:`\log|\det| = \log|\det \mathrm{BoxSquash}| + d \log s`.

    Where nothing binds, s = 1 and the action is that of a tanh-squashed Gaussian. The log-density
    has no limit at the centre, where its gradient grows like :math:`1/|v|` (`docs/method.md`).
    The image is the region eroded by rounding error: saturated samples satisfy every active
    constraint with zero tolerance.

    Args:
        region: sets, centre and active flags, ``(*batch,)`` of them.
        validate_args: check the action bounds, which reads them on the host.
    """

    def __init__(self, region: Region, *, validate_args: bool = True) -> None:
        super().__init__()
        if validate_args:
            region.bounds.validate()
        eroded = region.eroded()
        self._box = BoxSquash.onto(eroded.bounds, validate_args=validate_args)
        # The very bounds of the squash in floating point, not a rounding away from them: a gauge of
        # 1 + e at the bounds would let the last stage overshoot by e times the distance to the
        # centre, and near a bound one rounding error is a large e.
        sets = (self._box.image, *eroded.sets[1:])
        self.region = Region(sets, region.centre, region.active, validate_args=False)

    @property
    def shape(self) -> torch.Size:
        return region_shape(self.region)

    def forward_and_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        bounded, log_det = self._box.forward_and_log_det(latent)
        share = self._share(bounded - self.region.centre)
        action = scale_about(self.region.centre, bounded, share)
        return action, log_det + latent.shape[-1] * share.log()

    def forward_and_reference_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        bounded, log_det = self._box.forward_and_log_det(latent)
        share = self._share(bounded - self.region.centre)
        return scale_about(self.region.centre, bounded, share), log_det

    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        share = self._share(action - self.region.centre)
        bounded = scale_about(self.region.centre, action, 1 / share)
        latent, log_det = self._box.inverse_and_log_det(bounded)
        return latent, log_det - latent.shape[-1] * share.log()

    def contains(self, action: Tensor) -> Tensor:
        share = self._share(action - self.region.centre)
        return self._box.contains(scale_about(self.region.centre, action, 1 / share))

    def stages(self, latent: Tensor) -> Stages:
        bounded, log_det = self._box.forward_and_log_det(latent)
        direction, zero = scaled_direction(bounded - self.region.centre)
        gauges = self.region.gauges(direction)
        shares = share_of(gauges[0], gauges, zero)
        actions = scale_about(self.region.centre, bounded, shares)
        return Stages(actions, log_det + latent.shape[-1] * shares.log())

    def _share(self, offset: Tensor) -> Tensor:
        direction, zero = scaled_direction(offset)
        outer, inner = self.region.outer_and_inner_gauge(direction)
        return share_of(outer, inner, zero)
