"""The radial tanh squash into a ball."""

from __future__ import annotations

import torch
from torch import Tensor

from cnfp_torchrl.bijectors.bijector import Bijector
from cnfp_torchrl.bijectors.hyperbolic import atanhc, radial_log_det, tanhc
from cnfp_torchrl.geometry import Ball, GeometryError
from cnfp_torchrl.geometry.shapes import broadcast_shape


def squash_to_unit_ball(latent: Tensor) -> tuple[Tensor, Tensor]:
    """Return the radial squash of R^d into the unit ball and its log-determinant."""
    q = latent.square().sum(-1)
    return latent * tanhc(q).unsqueeze(-1), radial_log_det(q, latent.shape[-1])


def unsquash_from_unit_ball(point: Tensor) -> tuple[Tensor, Tensor]:
    """Return the latent of a point and the inverse's log-determinant.

    Outside the open unit ball both are infinite or NaN.
    """
    latent = point * atanhc(point.square().sum(-1)).unsqueeze(-1)
    return latent, -radial_log_det(latent.square().sum(-1), latent.shape[-1])


class BallSquash(Bijector):
    r"""Squash R^d radially into a ball, :math:`a = m + r \tanh(\rho)\, z/\rho`, :math:`\rho = |z|`.

    :math:`\log|\det| = d \log r + L(\rho) + (d - 1) \log(\tanh(\rho)/\rho)`. The image is the ball
    eroded by rounding error. Source: paper, section Method.

    Args:
        center: m, ``(*batch, d)``.
        radius: r, ``(*batch,)``.
        validate_args: check the arguments, which reads them on the host.

    Raises:
        GeometryError: when the radius is not positive and finite, or nothing is left of the ball
            after erosion.
    """

    def __init__(self, center: Tensor, radius: Tensor, *, validate_args: bool = True) -> None:
        super().__init__()
        self._ball = Ball(center, radius, validate_args=validate_args).eroded()
        if validate_args and not bool((self._ball.radius > 0).all()):
            raise GeometryError(
                f"BallSquash: expected a radius above rounding error in {center.dtype}, "
                f"given radius {radius.tolist()}, center {center.tolist()}"
            )

    @property
    def shape(self) -> torch.Size:
        batch = broadcast_shape(self._ball.center.shape[:-1], self._ball.radius.shape)
        return torch.Size((*batch, self._ball.dim))

    def forward_and_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        point, log_det = squash_to_unit_ball(latent)
        action = self._ball.center + self._ball.radius.unsqueeze(-1) * point
        return action, log_det + latent.shape[-1] * self._ball.radius.log()

    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        point = (action - self._ball.center) / self._ball.radius.unsqueeze(-1)
        latent, log_det = unsquash_from_unit_ball(point)
        return latent, log_det - action.shape[-1] * self._ball.radius.log()
