"""Scaling of offsets component by component, by one factor on each side of the anchor."""

from __future__ import annotations

from typing import Self

import torch
from torch import Tensor

from cnfp_torchrl.geometry import Box
from cnfp_torchrl.geometry.box import sides


class ComponentScale:
    r"""The bijection :math:`v_i \mapsto v_i \rho_i`, with one factor for each sign of a component.

    Args:
        above: factors of positive components, ``(*batch, d)``, positive.
        below: factors of negative components, ``(*batch, d)``, positive.
    """

    def __init__(self, above: Tensor, below: Tensor) -> None:
        self._above, self._below = above, below
        log_above, log_below = above.log(), below.log()
        self._log_mean = torch.lerp(log_below, log_above, 0.5)
        self._log_half_ratio = log_above - self._log_mean

    @classmethod
    def between(cls, outer: Box, inner: Box) -> Self:
        """Return the scale that takes one box onto another, each with 0 inside."""
        return cls(inner.high / outer.high, inner.low / outer.low)

    def forward(self, ahead: Tensor, behind: Tensor) -> Tensor:
        """Return the scaled offset ``(*batch, d)`` of an offset given by its `sides`."""
        return torch.addcmul(ahead * self._above, behind, self._below, value=-1)

    def inverse(self, scaled: Tensor) -> Tensor:
        """Return the offset of a scaled one."""
        ahead, behind = sides(scaled)
        return torch.addcdiv(ahead / self._above, behind, self._below, value=-1)

    def log_slopes(self, offset: Tensor) -> Tensor:
        r"""Return :math:`\log \rho_i` of each component, ``(*batch, d)``."""
        # Arithmetic with the sign, because masks are slow to make and to convert.
        return torch.addcmul(self._log_mean, offset.detach().sign(), self._log_half_ratio)
