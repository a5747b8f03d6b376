"""The radial squash of R^d onto a region, without stages."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.bijectors.bijector import Bijector, Stages
from cnfp_torchrl.bijectors.squashes import radial_log_det, squash_to_unit_ball
from cnfp_torchrl.geometry import Region, require_action_bounds, scaled_direction


class RadialSquash(Bijector):
    r"""Squash R^d onto a region along rays from its anchor, :math:`a = c + \tanh(\rho)\, u/g(u)`.

    With :math:`\rho = |z|`, :math:`u = z/\rho` and g the region's gauge,
    :math:`\log|\det| = -d \log g(u) + L(\rho) + (d - 1) \log(\tanh(\rho)/\rho)`: the squash into
    the unit ball, then a stretch of each ray to the boundary. Exact in any dimension, but useful in
    one or two: the length of a Gaussian in R^d is near :math:`\sqrt d`, so in many dimensions all
    samples land near the boundary (`docs/method.md`, section 2).

    Args:
        region: Regions of batch shape ``(*batch,)``.
        validate_args: Whether to check the action bounds, which reads them on the host.

    Raises:
        GeometryError: when the action bounds are invalid.
    """

    def __init__(self, region: Region, *, validate_args: bool = True) -> None:
        super().__init__()
        if validate_args:
            require_action_bounds(region.bounds)
        self.region = region.eroded()

    @property
    def shape(self) -> torch.Size:
        return self.region.shape

    def forward_and_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        direction, _ = scaled_direction(latent)
        _, gauge = self.region.outer_and_inner_gauge(direction)
        return self._stretch(latent, direction, gauge)

    def forward_and_reference_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        direction, _ = scaled_direction(latent)
        outer, inner = self.region.outer_and_inner_gauge(direction)
        action, log_det = self._stretch(latent, direction, inner)
        return action, log_det + latent.shape[-1] * (inner / outer).log()

    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        offset = action - self.region.anchor
        direction, _ = scaled_direction(offset)
        _, gauge = self.region.outer_and_inner_gauge(direction)
        length = vector_norm(direction, dim=-1)
        rho = (offset.abs().amax(-1) * gauge).atanh()
        latent = direction * (rho / length).unsqueeze(-1)
        log_det = radial_log_det(rho.square(), action.shape[-1])
        return latent, action.shape[-1] * (gauge / length).log() - log_det

    def stages(self, latent: Tensor) -> Stages:
        direction, _ = scaled_direction(latent)
        return Stages(*self._stretch(latent, direction, self.region.gauges(direction)))

    def _stretch(self, latent: Tensor, direction: Tensor, gauge: Tensor) -> tuple[Tensor, Tensor]:
        point, log_det = squash_to_unit_ball(latent)
        width = vector_norm(direction, dim=-1) / gauge
        action = self.region.anchor + width.unsqueeze(-1) * point
        return action, log_det + latent.shape[-1] * width.log()
