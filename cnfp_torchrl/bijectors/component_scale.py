"""Scaling of offsets component by component, by one factor on each side of the centre."""

from __future__ import annotations

from typing import Self

import torch
from torch import Tensor

from cnfp_torchrl.geometry import Box


class ComponentScale:
    r"""The bijection :math:`v_i \mapsto v_i \rho_i`, with one factor for each sign of a component.

    Args:
        above: factors of positive components, ``(*batch, d)``, positive.
        below: factors of negative components, ``(*batch, d)``, positive.
    """

    def __init__(self, above: Tensor, below: Tensor) -> None:
        self._above, self._below = above, below
        log_above, log_below = above.log(), below.log()
        self._log_mean = (log_above + log_below) / 2
        self._log_half_ratio = (log_above - log_below) / 2

    @classmethod
    def between(cls, outer: Box, inner: Box) -> Self:
        """Return the scale that takes one box onto another, each with 0 inside."""
        return cls(inner.high / outer.high, inner.low / outer.low)

    def forward(self, offset: Tensor) -> Tensor:
        """Return the scaled offset ``(*batch, d)``."""
        return _scaled(offset, self._above, self._below)

    def inverse(self, scaled: Tensor) -> Tensor:
        """Return the offset of a scaled one."""
        return _scaled(scaled, self._above.reciprocal(), self._below.reciprocal())

    def log_slopes(self, offset: Tensor) -> Tensor:
        r"""Return :math:`\log \rho_i` of each component, ``(*batch, d)``."""
        # Arithmetic with the sign, because masks are slow to make and to convert.
        return torch.addcmul(self._log_mean, offset.detach().sign(), self._log_half_ratio)


def _scaled(offset: Tensor, above: Tensor, below: Tensor) -> Tensor:
    ahead = offset.relu()
    return torch.addcmul(ahead * above, offset - ahead, below)
