"""Bijectors applied one after the other."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from cnfp_torchrl.bijectors.bijector import Bijector, Stages, log_det_zero
from cnfp_torchrl.geometry import broadcast_shape


class SquashChain(Bijector):
    r"""Apply bijectors in order, :math:`a = f_1(f_2(\dots f_K(z)))` with :math:`f_K` listed first.

    The log-determinants add up (paper, eq. normalizing_flow). A chain of squashes is the paper's
    policy. **Only the last bijector's set is guaranteed**, because each bijector moves actions out
    of the sets of those before it. `ExactSquash` guarantees all.

    Args:
        bijectors: Bijectors in order of application, the last one with the highest priority.

    Raises:
        ValueError: when there is no bijector.
    """

    def __init__(self, bijectors: Sequence[Bijector]) -> None:
        super().__init__()
        if not bijectors:
            raise ValueError("bijectors: expected at least one, given an empty chain")
        self.bijectors = tuple(bijectors)

    @property
    def shape(self) -> torch.Size:
        return broadcast_shape(*(bijector.shape for bijector in self.bijectors))

    def forward_and_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        action, total = latent, log_det_zero(latent)
        for bijector in self.bijectors:
            action, log_det = bijector.forward_and_log_det(action)
            total = total + log_det
        return action, total

    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        latent, total = action, log_det_zero(action)
        for bijector in reversed(self.bijectors):
            latent, log_det = bijector.inverse_and_log_det(latent)
            total = total + log_det
        return latent, total

    def stages(self, latent: Tensor) -> Stages:
        action = latent.expand(broadcast_shape(latent.shape, self.shape))
        total = log_det_zero(action)
        actions, log_dets = [], []
        for bijector in self.bijectors:
            inner = bijector.stages(action)
            actions.append(inner.actions)
            log_dets.append(total + inner.log_dets)
            action, total = inner.actions[-1], log_dets[-1][-1]
        return Stages(torch.cat(actions), torch.cat(log_dets))
