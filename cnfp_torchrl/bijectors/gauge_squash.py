"""The exact flow: a tanh squash into the action bounds, then radial retractions into the region."""

from __future__ import annotations

from itertools import accumulate

import torch
from torch import Tensor

from cnfp_torchrl.bijectors.bijector import Bijector, Stages
from cnfp_torchrl.bijectors.box_squash import BoxSquash
from cnfp_torchrl.bijectors.rays import Rays, region_shape
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
        self.region = Region(sets, region.centre, validate_args=False)
        self._outer, *self._inner = (each.gauge_about(region.centre) for each in sets)

    @property
    def shape(self) -> torch.Size:
        return region_shape(self.region)

    def forward_and_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        bounded, log_det = self._box.forward_and_log_det(latent)
        action, share = self._retract(bounded)
        return action, torch.add(log_det, share.log(), alpha=latent.shape[-1])

    def forward_and_reference_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        bounded, log_det = self._box.forward_and_log_det(latent)
        return self._retract(bounded)[0], log_det

    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        bounded, share = self._expand(action)
        latent, log_det = self._box.inverse_and_log_det(bounded)
        return latent, log_det - latent.shape[-1] * share.log()

    def contains(self, action: Tensor) -> Tensor:
        return self._box.contains(self._expand(action)[0])

    def stages(self, latent: Tensor) -> Stages:
        bounded, log_det = self._box.forward_and_log_det(latent)
        offset = bounded - self.region.centre
        shares = self._shares(offset)
        actions = torch.addcmul(self.region.centre, offset, shares.unsqueeze(-1))
        return Stages(actions, torch.add(log_det, shares.log(), alpha=latent.shape[-1]))

    def _retract(self, bounded: Tensor) -> tuple[Tensor, Tensor]:
        offset = bounded - self.region.centre
        share = self._share(offset)
        return torch.addcmul(self.region.centre, offset, share.unsqueeze(-1)), share

    def _expand(self, action: Tensor) -> tuple[Tensor, Tensor]:
        offset = action - self.region.centre
        share = self._share(offset)
        return self.region.centre + offset / share.unsqueeze(-1), share

    def _share(self, offset: Tensor) -> Tensor:
        return Rays(offset, self._outer).share_of_all(self._inner)

    def _shares(self, offset: Tensor) -> Tensor:
        """Return the share after each stage, ``(K + 1, *batch)``."""
        rays = Rays(offset, self._outer)
        gauges = (gauge(rays.direction) for gauge in self._inner)
        running = [rays.share(gauge) for gauge in accumulate(gauges, torch.maximum)]
        return torch.stack(torch.broadcast_tensors(torch.ones_like(rays.progress), *running))
