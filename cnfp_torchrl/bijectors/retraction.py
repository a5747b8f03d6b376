"""One retraction on its own: from a set into its intersection with another."""

from __future__ import annotations

import torch
from torch import Tensor

from cnfp_torchrl.bijectors.bijector import Bijector
from cnfp_torchrl.bijectors.exact_squash import contraction_along_rays
from cnfp_torchrl.geometry import Box, ConstraintSet, broadcast_shape


class Retraction(Bijector):
    r"""Retract a set radially onto its intersection with another one, about a common anchor.

    With :math:`v = x - c`: :math:`a = c + v/r`, :math:`r = \max(1, g_{inner}(v)/g_{outer}(v))`,
    :math:`\log|\det| = -d \log r`.

    Args:
        outer: The set that arguments lie in, bounded in every direction. It is not eroded here,
            because a squash onto it has left a margin already. An argument beyond it by a rounding
            error would leave the inner set by the same share of the distance to the boundary.
        inner: The set to retract into; it is eroded here.
        anchor: Points strictly inside both sets, ``(*batch, d)``.
    """

    def __init__(self, outer: ConstraintSet, inner: ConstraintSet, anchor: Tensor) -> None:
        super().__init__()
        inner = inner.eroded(Box(*outer.bounding_box(), validate_args=False).magnitude())
        self._outer, self._inner, self._anchor = outer, inner, anchor
        self._outer_gauge = outer.gauge_about(anchor)
        self._inner_gauge = inner.gauge_about(anchor)

    @property
    def shape(self) -> torch.Size:
        batch = broadcast_shape(
            self._anchor.shape[:-1], self._outer.batch_shape, self._inner.batch_shape
        )
        return torch.Size((*batch, self._anchor.shape[-1]))

    def forward_and_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        offset = latent - self._anchor
        _, contraction = self._progress_and_contraction(offset)
        action = self._anchor + offset / contraction.unsqueeze(-1)
        return action, -latent.shape[-1] * contraction.log()

    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        offset = action - self._anchor
        progress, contraction = self._progress_and_contraction(offset)
        # Rays that would leave the outer set have no argument.
        contraction = torch.where(progress * contraction < 1, contraction, torch.nan)
        latent = self._anchor + offset * contraction.unsqueeze(-1)
        return latent, action.shape[-1] * contraction.log()

    def _progress_and_contraction(self, offset: Tensor) -> tuple[Tensor, Tensor]:
        progress = self._outer_gauge(offset)
        return progress, contraction_along_rays(offset, progress, [self._inner_gauge])
