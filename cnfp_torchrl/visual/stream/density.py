"""The density of a flow policy after each stage, on a fixed grid of actions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cnfp_torchrl.visual.outlines import Line
from cnfp_torchrl.visual.snapshot import FlowSnapshot

Heat: TypeAlias = NDArray[np.uint8]

_DEPTH = 7.0
"""Densities of this many nats below the highest are drawn as nothing."""
_SPIKES = 0.995
"""A saturated flow crowds at boundaries without limit; this share of the cells sets the scale."""


class ActionGrid:
    """The middles of equal cells over a box of actions of one or two components.

    Args:
        limits: lowest and highest value of each component.
        cells: along each component.
    """

    def __init__(self, limits: Sequence[tuple[float, float]], cells: int) -> None:
        share = (torch.arange(cells) + 0.5) / cells
        axes = [low + (high - low) * share for low, high in limits]
        # One component after the other in memory: to add up two neighbors takes thrice as long.
        self.actions = torch.stack(torch.meshgrid(*axes, indexing="xy")).movedim(0, -1)
        """``(cells, d)`` or, the second component first, ``(cells, cells, d)``."""

    def log_densities(self, snapshot: FlowSnapshot) -> Tensor:
        """Return the log-density after each stage, ``(stages, *cells)``; -inf outside.

        In the precision of the snapshot, which is much finer than colors are.

        Args:
            snapshot: the policy in a state.
        """
        given = self.actions.reshape(-1, snapshot.dim)
        return snapshot.log_densities(given).unflatten(1, self.actions.shape[:-1])

    def curves(self, log_density: Tensor) -> list[Line]:
        """Return actions and densities, in one dimension, of each stage, ``(cells, 2)``.

        Args:
            log_density: of all stages of one step, ``(stages, cells)``; the highest is drawn at 1.
        """
        values = log_density.numpy()
        heights = np.exp(np.minimum(values - _top(values), 0.0))
        return [np.stack([self.actions[:, 0].numpy(), each], axis=-1) for each in heights]


def as_bytes(log_density: Tensor) -> Heat:
    """Return log-densities as brightness: 0 where there is next to none, 255 at most.

    Args:
        log_density: of all stages of one step, which compare with each other.
    """
    values = log_density.numpy()
    share = np.clip((values - (_top(values) - _DEPTH)) / _DEPTH, 0.0, 1.0)
    return np.round(255 * share).astype(np.uint8)


def _top(values: NDArray[np.float64]) -> float:
    """Return the log-density that the scale ends at, 0 where there is none at all."""
    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        return 0.0
    rank = int(_SPIKES * (len(finite) - 1))
    return float(np.partition(finite, rank)[rank])
