"""The exact flow where boxes are retracted component by component and other sets radially."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from cnfp_torchrl.bijectors.bijector import Bijector, Stages
from cnfp_torchrl.bijectors.box_squash import BoxSquash
from cnfp_torchrl.bijectors.rays import Rays, region_shape
from cnfp_torchrl.geometry import Box, ConstraintSet, Region


class AlignedSquash(Bijector):
    r"""Squash R^d exactly onto the intersection of all active sets of a region.

    Stage 0 is the box squash into the action bounds B, :math:`x = \mathrm{BoxSquash}(z)`. Let c be
    the centre, :math:`v = x - c`, and :math:`B_k` the intersection of B with the boxes among the
    first k constraints. What boxes forbid is taken out in each component on its own,

    .. math:: w_i = v_i\, \rho_i, \quad \rho_i = room_i(B_k) / room_i(B),

    with :math:`room_i` the distance from c to the side that :math:`v_i` points to, and what the
    other sets forbid along the ray: with :math:`G_k` the gauge of their intersection with
    :math:`B_k`, :math:`a_k = c + s w`, :math:`s = g_{B_k}(w)/G_k(w)`. At the last stage
    :math:`\log|\det| = \log|\det \mathrm{BoxSquash}| + \sum_i \log \rho_i + d \log s`.

    A box beside the agent thus leaves the motion along it alone, which a retraction of the whole
    vector (`GaugeSquash`) shortens with the motion towards it. Without boxes among the constraints
    both are the same. The log-density jumps where a component of v changes its sign, and where
    other sets bind it has no limit at the centre (`docs/method.md`). The image is the region eroded
    by rounding error: saturated samples satisfy every active constraint with zero tolerance.

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
        # The very bounds of the squash in floating point, see `GaugeSquash`.
        sets = (self._box.image, *eroded.sets[1:])
        self.region = Region(sets, region.centre, validate_args=False)
        self._retraction = _Retraction(self._box.image, sets[1:], region.centre)

    @property
    def shape(self) -> torch.Size:
        return region_shape(self.region)

    def forward_and_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        bounded, log_det = self._box.forward_and_log_det(latent)
        action, of_retraction = self._retraction.forward_and_log_det(bounded)
        return action, log_det + of_retraction

    def forward_and_reference_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        bounded, log_det = self._box.forward_and_log_det(latent)
        return self._retraction.forward(bounded), log_det

    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        bounded, of_retraction = self._retraction.inverse_and_log_det(action)
        latent, log_det = self._box.inverse_and_log_det(bounded)
        return latent, log_det + of_retraction

    def contains(self, action: Tensor) -> Tensor:
        return self._box.contains(self._retraction.inverse_and_log_det(action)[0])

    def stages(self, latent: Tensor) -> Stages:
        bounded, log_det = self._box.forward_and_log_det(latent)
        sets, centre = self.region.sets, self.region.centre
        # Each stage is the flow of the constraints so far: boxes come first in all of them.
        retractions = [
            _Retraction(self._box.image, sets[1:stage], centre).forward_and_log_det(bounded)
            for stage in range(1, len(sets) + 1)
        ]
        actions, log_dets = zip(*retractions, strict=True)
        return Stages(
            torch.stack(torch.broadcast_tensors(*actions)),
            log_det + torch.stack(torch.broadcast_tensors(*log_dets)),
        )


class _Retraction:
    """The bijection from the action bounds onto their intersection with some sets."""

    def __init__(self, bounds: Box, sets: Sequence[ConstraintSet], centre: Tensor) -> None:
        boxes = [each for each in sets if isinstance(each, Box)]
        merged = bounds
        for box in boxes:
            low, high = torch.maximum(merged.low, box.low), torch.minimum(merged.high, box.high)
            merged = Box(low, high, validate_args=False)
        self._centre = centre
        self._scales: tuple[Tensor, Tensor] | None = None
        if boxes:
            above = (merged.high - centre) / (bounds.high - centre)
            self._scales = above, (centre - merged.low) / (centre - bounds.low)
        self._outer = merged.gauge_about(centre)
        self._inner = [each.gauge_about(centre) for each in sets if not isinstance(each, Box)]

    def forward(self, bounded: Tensor) -> Tensor:
        return self._forward(bounded - self._centre)[0]

    def forward_and_log_det(self, bounded: Tensor) -> tuple[Tensor, Tensor]:
        offset = bounded - self._centre
        action, share = self._forward(offset)
        return action, self._log_det(offset, share)

    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        scaled = action - self._centre
        # The share depends on the direction alone.
        share = self._share(scaled)
        scaled = scaled / share.unsqueeze(-1)
        offset = scaled
        if self._scales is not None:
            offset = _scaled(scaled, *(1 / scale for scale in self._scales))
        return self._centre + offset, -self._log_det(offset, share)

    def _forward(self, offset: Tensor) -> tuple[Tensor, Tensor]:
        scaled = offset if self._scales is None else _scaled(offset, *self._scales)
        share = self._share(scaled)
        return torch.addcmul(self._centre, scaled, share.unsqueeze(-1)), share

    def _share(self, scaled: Tensor) -> Tensor:
        rays = Rays(scaled, self._outer)
        return rays.share_of_all(self._inner)

    def _log_det(self, offset: Tensor, share: Tensor) -> Tensor:
        log_det = offset.shape[-1] * share.log()
        if self._scales is None:
            return log_det
        above, below = (scale.log() for scale in self._scales)
        ahead = (offset > 0).to(offset.dtype)
        return log_det + torch.addcmul(below, ahead, above - below).sum(-1)


def _scaled(offset: Tensor, above: Tensor, below: Tensor) -> Tensor:
    """Return an offset with its positive and negative components scaled."""
    ahead = offset.relu()
    return torch.addcmul(ahead * above, offset - ahead, below)
