"""The radial tanh squash into an ellipsoid."""

from __future__ import annotations

import torch
from torch import Tensor

from cnfp_torchrl.bijectors.ball_squash import squash_to_unit_ball, unsquash_from_unit_ball
from cnfp_torchrl.bijectors.bijector import Bijector
from cnfp_torchrl.geometry import Ellipsoid, GeometryError
from cnfp_torchrl.geometry.shapes import broadcast_shape


class EllipsoidSquash(Bijector):
    r"""Squash R^d into an ellipsoid, :math:`a = m + T \tanh(\rho)\, z/\rho`, :math:`\rho = |z|`.

    :math:`\log|\det| = \log\det T + L(\rho) + (d - 1) \log(\tanh(\rho)/\rho)`. The image is the
    ellipsoid eroded by rounding error. Source: paper, section Method.

    Args:
        center: m, ``(*batch, d)``.
        scale_tril: T, lower triangular with a positive diagonal, ``(*batch, d, d)``.
        validate_args: check the arguments, which reads them on the host.

    Raises:
        GeometryError: when T is not lower triangular with a positive diagonal, or nothing is left
            of the ellipsoid after erosion.
    """

    def __init__(self, center: Tensor, scale_tril: Tensor, *, validate_args: bool = True) -> None:
        super().__init__()
        whole = Ellipsoid(center, scale_tril, validate_args=validate_args)
        self._ellipsoid = whole.eroded()
        # Erosion leaves a speck of an ellipsoid that is too thin for it, not an empty set.
        if validate_args and not bool((_diagonal(self._ellipsoid) > _diagonal(whole) / 10).all()):
            raise GeometryError(
                f"EllipsoidSquash: expected an ellipsoid wider than rounding error in "
                f"{center.dtype}, given scale_tril {scale_tril.tolist()}, center {center.tolist()}"
            )

    @property
    def shape(self) -> torch.Size:
        center, scale_tril = self._ellipsoid.center, self._ellipsoid.scale_tril
        batch = broadcast_shape(center.shape[:-1], scale_tril.shape[:-2])
        return torch.Size((*batch, self._ellipsoid.dim))

    def forward_and_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        point, log_det = squash_to_unit_ball(latent)
        # Not a matrix product, which autocast and TF32 would compute in too few digits to stay
        # inside.
        offset = (self._ellipsoid.scale_tril * point.unsqueeze(-2)).sum(-1)
        return self._ellipsoid.center + offset, log_det + self._log_volume()

    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        point = self._ellipsoid.whiten(action - self._ellipsoid.center)
        latent, log_det = unsquash_from_unit_ball(point)
        return latent, log_det - self._log_volume()

    def _log_volume(self) -> Tensor:
        return _diagonal(self._ellipsoid).log().sum(-1)


def _diagonal(ellipsoid: Ellipsoid) -> Tensor:
    return ellipsoid.scale_tril.diagonal(dim1=-2, dim2=-1)
