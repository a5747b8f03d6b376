"""Bounds of positive parts, such as a limit of the power taken from a battery."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from cnfp_torchrl.geometry.constraint_set import EROSION_IN_EPS
from cnfp_torchrl.geometry.kinked_sum import KinkedSumBound


@dataclass(frozen=True, eq=False)
class PositivePart(KinkedSumBound):
    r"""The unbounded set :math:`\{a : \sum_i \max(weights_i a_i, 0) \le bound\}`.

    With joint velocities as weights and torques as actions it limits the power that the joints
    draw; power that they return does not count.

    Args:
        weights: ``(*batch, d)``, finite; zeros are allowed and leave their component free.
        bound: ``(*batch,)``, finite, 0 or more; at 0 nothing may be taken.
    """

    @staticmethod
    def slopes(weights: Tensor) -> tuple[Tensor, Tensor]:
        return weights.clamp(min=0), weights.clamp(max=0)

    def eroded(self, magnitude: Tensor | float = 1.0) -> Self:
        # Terms may be as negative as the actions allow on the way to where they become positive.
        eps = EROSION_IN_EPS * torch.finfo(self.dtype).eps
        size = self.bound + self.weights.abs().sum(-1) * magnitude
        return type(self)(self.weights, self.bound - eps * size, validate_args=False)
