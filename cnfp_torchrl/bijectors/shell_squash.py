"""The radial squash into a shell: actions neither too near to a point nor too far from it."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.bijectors.bijector import Bijector
from cnfp_torchrl.bijectors.squashes import log_sech_squared
from cnfp_torchrl.geometry import (
    EROSION_IN_EPS,
    GeometryError,
    Region,
    broadcast_shape,
    length,
    require_action_bounds,
    scaled_direction,
)


class ShellSquash(Bijector):
    r"""Squash R^d into the shell :math:`inner \le |a - m| \le outer`, along rays from m.

    :math:`a = m + \phi(\rho)\, z/\rho` with :math:`\rho = |z|` and :math:`\phi(\rho) = r_{in} +
    (r_{out} - r_{in}) \tanh \rho`, so :math:`\log|\det| = (d - 1) \log(\phi/\rho) + \log
    \phi'(\rho)`. With a region about the same anchor, :math:`r_{out}(u) = \min(outer, 1/g(u))`
    along each ray: the part of the region outside the inner ball.

    A shell is not convex, and not star-shaped about any point: this is a bijector of its own, not a
    set that others intersect. Its hole has no preimage, so the latent's origin is torn apart: the
    action jumps there, and the log-determinant grows like :math:`-(d - 1) \log \rho`.

    Args:
        center: Centers m, ``(*batch, d)``.
        inner: Radii of the hole, ``(*batch,)``.
        outer: Outer radii, ``(*batch,)``.
        region: Regions of further sets that actions must satisfy, with m as the anchor. They must
            reach beyond the hole along every ray; a ray on which they do not gives NaN, which
            environments refuse.
        validate_args: Whether to check the arguments, which reads them on the host.

    Raises:
        GeometryError: unless 0 < inner < outer, both finite, with room between them for the dtype.
    """

    def __init__(
        self,
        center: Tensor,
        inner: Tensor,
        outer: Tensor,
        region: Region | None = None,
        *,
        validate_args: bool = True,
    ) -> None:
        super().__init__()
        margin = EROSION_IN_EPS * torch.finfo(center.dtype).eps
        margin = margin * (outer + vector_norm(center, dim=-1))
        self._center, self._inner, self._outer = center, inner + margin, outer - margin
        if validate_args and not bool(((inner > 0) & (self._inner < self._outer)).all()):
            raise GeometryError(
                f"ShellSquash: expected 0 < inner < outer, not closer than {center.dtype} can tell "
                f"apart, given inner {inner.tolist()}, outer {outer.tolist()}"
            )
        if validate_args and region is not None:
            require_action_bounds(region.bounds)
        self._region = None if region is None else region.eroded()

    @property
    def shape(self) -> torch.Size:
        region = () if self._region is None else (self._region.shape[:-1],)
        batch = broadcast_shape(self._center.shape[:-1], self._inner.shape, *region)
        return torch.Size((*batch, self._center.shape[-1]))

    def forward_and_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        direction, unit_length, width = self._rays(latent)
        rho = length(latent)
        radius = self._inner + width * rho.tanh()
        action = self._center + direction * (radius / unit_length).unsqueeze(-1)
        return action, self._log_det(rho, radius, width, latent.shape[-1])

    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        offset = action - self._center
        direction, unit_length, width = self._rays(offset)
        radius = vector_norm(offset, dim=-1)
        depth = (radius - self._inner) / width
        # NaN in the hole, which has no latent, not the negative values of artanh.
        rho = torch.where(depth > 0, depth, torch.nan).atanh()
        latent = direction * (rho / unit_length).unsqueeze(-1)
        return latent, -self._log_det(rho, radius, width, action.shape[-1])

    def _rays(self, offset: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return direction, its length, and the width of the shell along it."""
        direction, _ = scaled_direction(offset)
        unit_length = vector_norm(direction, dim=-1)
        outer = self._outer
        if self._region is not None:
            _, gauge = self._region.outer_and_inner_gauge(direction)
            outer = torch.minimum(outer, unit_length / gauge)
        width = outer - self._inner
        # NaN, not a width of 0, on rays without an allowed action: the region ends in the hole.
        return direction, unit_length, torch.where(width > 0, width, torch.nan)

    @staticmethod
    def _log_det(rho: Tensor, radius: Tensor, width: Tensor, dim: int) -> Tensor:
        log_slope = width.log() + log_sech_squared(rho)
        return log_slope + (dim - 1) * (radius.log() - rho.log()) if dim > 1 else log_slope
