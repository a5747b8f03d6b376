r"""The paper's tanh squashes into a box, a ball or an ellipsoid, and their hyperbolic functions.

The functions have stable values and gradients at any argument. Functions of a length
:math:`\rho` take its square q, in which they are smooth at 0. Below `SMALL` they are power series,
whose first neglected term is less than the rounding error of float64 there.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Self

import torch
from torch import Tensor
from torch.nn.functional import softplus

from cnfp_torchrl.bijectors.bijector import Bijector
from cnfp_torchrl.geometry import (
    Ball,
    Box,
    ConstraintSet,
    Ellipsoid,
    GeometryError,
    component_sum,
    power_of_two,
    require_action_bounds,
)

SMALL = 0.01

# Above it softplus(x) = x in float64; torch's own threshold of 20 leaves an error of 4e-9. With
# beta = 2 torch's softplus is half of softplus(2x), and the threshold is one for 2x.
_SOFTPLUS_IS_IDENTITY = 40.0

# Coefficients of q^0, q^1, ... of tanh(rho)/rho, log(tanh(rho)/rho), log(1 - tanh(rho)^2) and
# artanh(rho)/rho: Taylor series (DLMF 4.33.3, 4.38.5 and their logarithms).
_TANHC = (1.0, -1 / 3, 2 / 15, -17 / 315, 62 / 2835, -1382 / 155925, 21844 / 6081075)
_LOG_TANHC = (0.0, -1 / 3, 7 / 90, -62 / 2835, 127 / 18900, -146 / 66825, 1414477 / 1915538625)
_LOG_SECH_SQUARED = (0.0, -1.0, 1 / 6, -2 / 45, 17 / 1260, -62 / 14175, 691 / 467775)
_ATANHC = tuple(1 / (2 * k + 1) for k in range(8))


class BoxSquash(Bijector):
    r"""Squash R^d into a box elementwise, :math:`a = low + (high - low)(\tanh z + 1)/2`.

    :math:`\log|\det| = \sum_i \log((high_i - low_i)/2) + L(z_i)` with
    :math:`L(z) = \log(1 - \tanh^2 z)`. The image is the box eroded by rounding error, so that a
    saturated action satisfies the bounds with zero tolerance. Source: paper, section Method.

    Args:
        low: Lower bounds ``(*batch, d)``.
        high: Upper bounds ``(*batch, d)``.
        validate_args: Whether to check the bounds, which reads them on the host.

    Raises:
        GeometryError: when a bound is not finite, low >= high, or bounds are closer than rounding
            error or out of the dtype's range (`cnfp_torchrl.geometry.require_action_bounds`).
    """

    def __init__(self, low: Tensor, high: Tensor, *, validate_args: bool = True) -> None:
        box = Box(low, high, validate_args=validate_args)
        if validate_args:
            require_action_bounds(box, "BoxSquash")
        self._set_image(box.eroded(box.magnitude()))

    @classmethod
    def onto(cls, image: Box) -> Self:
        """Return the squash onto a box that is already checked and eroded."""
        squash = cls.__new__(cls)
        squash._set_image(image)
        return squash

    def _set_image(self, image: Box) -> None:
        super().__init__()
        self._middle, self._half = image.middle_and_half()
        self._log_slope_scale = (4 * self._half).log()

    def about(self, anchor: Tensor) -> Self:
        """Return the squash whose actions are given minus a point ``(*batch, d)``."""
        squash = type(self).__new__(type(self))
        Bijector.__init__(squash)
        squash._middle = self._middle - anchor
        squash._half, squash._log_slope_scale = self._half, self._log_slope_scale
        return squash

    @property
    def shape(self) -> torch.Size:
        return torch.broadcast_shapes(self._middle.shape, self._half.shape)

    @property
    def image(self) -> Box:
        """The closure of the image, with the bounds as computed for saturated samples."""
        low, high = self._middle - self._half, self._middle + self._half
        return Box(low, high, validate_args=False)

    def forward_and_log_slopes(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Return the action and each component's log-derivative, both ``(*batch, d)``."""
        return torch.addcmul(self._middle, self._half, latent.tanh()), self._log_slopes(latent)

    def forward_and_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        action, log_slopes = self.forward_and_log_slopes(latent)
        return action, component_sum(log_slopes)

    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        latent = ((action - self._middle) / self._half).atanh()
        return latent, -self._log_slopes(latent).sum(-1)

    def _log_slopes(self, latent: Tensor) -> Tensor:
        return torch.add(self._log_slope_scale, log_half_sech(latent), alpha=2)


class _UnitBallImage(Bijector):
    r"""Squash R^d radially into the unit ball, then map the ball affinely, :math:`a = m + T p`.

    :math:`p = \tanh(\rho)\, z/\rho` with :math:`\rho = |z|`, :math:`\log|\det| = \log\det T +
    L(\rho) + (d - 1) \log(\tanh(\rho)/\rho)`.
    """

    _image: Ball | Ellipsoid

    @property
    def shape(self) -> torch.Size:
        return torch.Size((*self._image.batch_shape, self._image.dim))

    def forward_and_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        point, log_det = squash_to_unit_ball(latent)
        return self._image.center + self._stretched(point), log_det + self._log_volume()

    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        point = self._image.whiten(action - self._image.center)
        # Outside the open unit ball both are infinite or NaN.
        latent = point * atanhc(point.square().sum(-1)).unsqueeze(-1)
        log_det = -radial_log_det(latent.square().sum(-1), action.shape[-1])
        return latent, log_det - self._log_volume()

    @abstractmethod
    def _stretched(self, point: Tensor) -> Tensor:
        """Return T p of points of the unit ball."""

    @abstractmethod
    def _log_volume(self) -> Tensor:
        """Return log det T, ``(*batch,)``."""


class BallSquash(_UnitBallImage):
    r"""Squash R^d radially into a ball, :math:`a = m + r \tanh(\rho)\, z/\rho`, :math:`\rho = |z|`.

    :math:`\log|\det| = d \log r + L(\rho) + (d - 1) \log(\tanh(\rho)/\rho)`. The image is the ball
    eroded by rounding error. Source: paper, section Method.

    Args:
        center: Centers m, ``(*batch, d)``.
        radius: Radii r, ``(*batch,)``.
        validate_args: Whether to check the arguments, which reads them on the host.

    Raises:
        GeometryError: when the radius is not positive and finite, or nothing is left of the ball
            after erosion.
    """

    def __init__(self, center: Tensor, radius: Tensor, *, validate_args: bool = True) -> None:
        super().__init__()
        self._image = Ball(center, radius, validate_args=validate_args).eroded()
        if validate_args and not bool((self._image.radius > 0).all()):
            raise GeometryError(
                f"BallSquash: expected a radius above rounding error in {center.dtype}, "
                f"given radius {radius.tolist()}, center {center.tolist()}"
            )

    _image: Ball

    def _stretched(self, point: Tensor) -> Tensor:
        return self._image.radius.unsqueeze(-1) * point

    def _log_volume(self) -> Tensor:
        return self._image.dim * self._image.radius.log()


class EllipsoidSquash(_UnitBallImage):
    r"""Squash R^d into an ellipsoid, :math:`a = m + T \tanh(\rho)\, z/\rho`, :math:`\rho = |z|`.

    :math:`\log|\det| = \log\det T + L(\rho) + (d - 1) \log(\tanh(\rho)/\rho)`. The image is the
    ellipsoid eroded by rounding error. Source: paper, section Method.

    Args:
        center: Centers m, ``(*batch, d)``.
        scale_tril: Matrices T, lower triangular with positive diagonals, ``(*batch, d, d)``.
        validate_args: Whether to check the arguments, which reads them on the host.

    Raises:
        GeometryError: when T is not lower triangular with a positive diagonal, or nothing is left
            of the ellipsoid after erosion.
    """

    def __init__(self, center: Tensor, scale_tril: Tensor, *, validate_args: bool = True) -> None:
        super().__init__()
        whole = Ellipsoid(center, scale_tril, validate_args=validate_args)
        self._image = whole.eroded()
        # Compared, not tested for being positive: erosion never empties an ellipsoid.
        if validate_args and not bool((_diagonal(self._image) > _diagonal(whole) / 10).all()):
            raise GeometryError(
                f"EllipsoidSquash: expected an ellipsoid wider than rounding error in "
                f"{center.dtype}, given scale_tril {scale_tril.tolist()}, center {center.tolist()}"
            )

    _image: Ellipsoid

    def _stretched(self, point: Tensor) -> Tensor:
        # Not a matrix product, which autocast and TF32 would compute in too few digits to stay
        # inside.
        return (self._image.scale_tril * point.unsqueeze(-2)).sum(-1)

    def _log_volume(self) -> Tensor:
        return _diagonal(self._image).log().sum(-1)


def _diagonal(ellipsoid: Ellipsoid) -> Tensor:
    return ellipsoid.scale_tril.diagonal(dim1=-2, dim2=-1)


PAPER_SQUASHES: dict[type[ConstraintSet], Callable[..., Bijector]] = {
    Box: BoxSquash,
    Ball: BallSquash,
    Ellipsoid: EllipsoidSquash,
}
"""Squashes that take a family's fields, by family; others may be added."""


def paper_squash(constraint_set: ConstraintSet) -> Bijector:
    """Return the paper's analytic squash of R^d onto one set, without checking its fields.

    Raises:
        TypeError: when the family has no squash; `ExactSquash` handles every family.
    """
    # A plain look-up, not functools.singledispatch, which torch.compile cannot trace.
    squash = PAPER_SQUASHES.get(type(constraint_set))
    if squash is None:
        raise TypeError(
            "expected a set with a squash of its own, one of "
            f"{[family.__name__ for family in PAPER_SQUASHES]}, given "
            f"{type(constraint_set).__name__}; use the exact flow (flow=exact)"
        )
    return squash(**constraint_set.fields(), validate_args=False)


def squash_to_unit_ball(latent: Tensor) -> tuple[Tensor, Tensor]:
    """Return the radial squash of R^d into the unit ball and its log-determinant."""
    # In units of the latent's size, whose square may be out of range.
    unit = power_of_two(latent.abs().amax(-1).clamp(min=1))
    scaled = latent / unit.unsqueeze(-1)
    q = scaled.square().sum(-1)
    log_det = radial_log_det(q, latent.shape[-1], unit)
    return scaled * tanhc(q, unit).unsqueeze(-1), log_det


def log_half_sech(x: Tensor) -> Tensor:
    r"""Return :math:`\log(\mathrm{sech}(x)/2) = x - \mathrm{softplus}(2x)`."""
    return torch.sub(x, softplus(x, beta=2, threshold=_SOFTPLUS_IS_IDENTITY), alpha=2)


def log_sech_squared(x: Tensor) -> Tensor:
    r"""Return :math:`L(x) = \log(1 - \tanh^2 x)`."""
    return 2 * (math.log(2) + log_half_sech(x))


def tanhc(q: Tensor, unit: Tensor | float = 1.0) -> Tensor:
    r"""Return :math:`\tanh(u \rho)/\rho` with :math:`q = \rho^2 \ge 0` and a unit u >= 1.

    The unit must be 1 where q < `SMALL`.
    """
    small = q < SMALL
    rho = torch.where(small, 1.0, q).sqrt()
    far = (unit * rho).tanh() / rho
    return torch.where(small, _series(_TANHC, torch.where(small, q, 0.0)), far)


def radial_log_det(q: Tensor, dim: int, unit: Tensor | float = 1.0) -> Tensor:
    r"""Return log|det| of the radial squash :math:`z \mapsto \tanh(\rho)\, z/\rho` of R^d.

    :math:`L(\rho) + (d - 1) \log(\tanh(\rho)/\rho)` at :math:`\rho = |z|`.

    Args:
        q: Squared lengths :math:`|z/u|^2`, ``(*batch,)``.
        dim: The dimension d.
        unit: Units u >= 1 of the lengths, ``(*batch,)``; 1 where q < `SMALL`.
    """
    small = q < SMALL
    near_q = torch.where(small, q, 0.0)
    rho = unit * torch.where(small, 1.0, q).sqrt()
    near, far = _series(_LOG_SECH_SQUARED, near_q), log_sech_squared(rho)
    if dim > 1:
        near = near + (dim - 1) * _series(_LOG_TANHC, near_q)
        far = far + (dim - 1) * (rho.tanh().log() - rho.log())
    return torch.where(small, near, far)


def atanhc(q: Tensor) -> Tensor:
    r"""Return :math:`\mathrm{artanh}(\rho)/\rho` with :math:`q = \rho^2 \in [0, 1)`."""
    small = q < SMALL
    rho = torch.where(small, 0.5, q).sqrt()
    return torch.where(small, _series(_ATANHC, torch.where(small, q, 0.0)), rho.atanh() / rho)


def _series(coefficients: Sequence[float], q: Tensor) -> Tensor:
    total = torch.full_like(q, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total = total * q + coefficient
    return total
