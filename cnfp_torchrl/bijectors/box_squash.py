"""The elementwise tanh squash into a box."""

from __future__ import annotations

from typing import Self

import torch
from torch import Tensor

from cnfp_torchrl.bijectors.bijector import Bijector
from cnfp_torchrl.bijectors.hyperbolic import log_half_sech
from cnfp_torchrl.geometry import Box, GeometryError


class BoxSquash(Bijector):
    r"""Squash R^d into a box elementwise, :math:`a = low + (high - low)(\tanh z + 1)/2`.

    :math:`\log|\det| = \sum_i \log((high_i - low_i)/2) + L(z_i)` with
    :math:`L(z) = \log(1 - \tanh^2 z)`. The image is the box eroded by rounding error, so that a
    saturated action satisfies the bounds with zero tolerance. Source: paper, section Method.

    Args:
        low: lower bounds ``(*batch, d)``.
        high: upper bounds ``(*batch, d)``.
        validate_args: check the bounds, which reads them on the host.

    Raises:
        GeometryError: when a bound is not finite, low >= high, or no room is left between the
            bounds after erosion.
    """

    def __init__(self, low: Tensor, high: Tensor, *, validate_args: bool = True) -> None:
        box = Box(low, high, validate_args=validate_args)
        self._set_image(box.eroded(box.magnitude()), validate_args)

    @classmethod
    def onto(cls, image: Box, *, validate_args: bool = True) -> Self:
        """Return the squash onto a box that is eroded already."""
        squash = cls.__new__(cls)
        squash._set_image(image, validate_args)
        return squash

    def _set_image(self, image: Box, validate_args: bool) -> None:
        super().__init__()
        if validate_args and bool(image.low.isinf().any() | image.high.isinf().any()):
            raise GeometryError(
                f"BoxSquash: expected finite bounds, given low {image.low.tolist()}, high "
                f"{image.high.tolist()}; an unbounded box has no tanh squash, use it as a "
                "constraint inside action bounds"
            )
        if validate_args and not bool((image.low < image.high).all()):
            raise GeometryError(
                f"BoxSquash: expected bounds further apart than rounding error in "
                f"{image.low.dtype}, given low {image.low.tolist()}, high {image.high.tolist()} "
                "after erosion"
            )
        self._middle = (image.low + image.high) / 2
        self._half = (image.high - image.low) / 2
        self._log_slope_scale = (4 * self._half).log()

    def about(self, anchor: Tensor) -> Self:
        """Return the squash in coordinates about a point ``(*batch, d)``: actions minus it."""
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
        """The closure of the image, with bounds as saturated samples reach them."""
        low, high = self._middle - self._half, self._middle + self._half
        return Box(low, high, validate_args=False)

    def forward_and_log_slopes(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Return the action and each component's log-derivative, both ``(*batch, d)``."""
        return torch.addcmul(self._middle, self._half, latent.tanh()), self._log_slopes(latent)

    def inverse_and_log_slopes(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return the latent and the log-derivatives there of the way forward."""
        latent = ((action - self._middle) / self._half).atanh()
        return latent, self._log_slopes(latent)

    def forward_and_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        action, log_slopes = self.forward_and_log_slopes(latent)
        return action, log_slopes.sum(-1)

    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        latent, log_slopes = self.inverse_and_log_slopes(action)
        return latent, -log_slopes.sum(-1)

    def _log_slopes(self, latent: Tensor) -> Tensor:
        return torch.add(self._log_slope_scale, log_half_sech(latent), alpha=2)
