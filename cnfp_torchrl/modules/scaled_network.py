"""A network that reads its inputs in units in which all of them are numbers around 1."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn


class ScaledNetwork(nn.Module):
    """Put inputs side by side, divide each component by a constant, and call a network.

    For inputs that are angles in degrees, pressures in pascal or the like. A network learns from
    numbers of some hundreds badly: its outputs, and the effect of a step of its weights, are as
    many times too large.

    Args:
        scale: What the components of all inputs together are divided by, ``(in,)``.
        network: The network, of one input.
    """

    scale: Tensor

    def __init__(self, scale: Sequence[float], network: nn.Module) -> None:
        super().__init__()
        self.register_buffer("scale", torch.tensor(list(scale), dtype=torch.get_default_dtype()))
        self.network = network

    def forward(self, *inputs: Tensor) -> Any:
        """Return what the network returns for the scaled inputs."""
        return self.network(torch.cat(inputs, -1) / self.scale)
