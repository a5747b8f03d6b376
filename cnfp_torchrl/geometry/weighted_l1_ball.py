"""Weighted L1 balls, such as a limit of mechanical power."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from cnfp_torchrl.geometry.constraint_set import EROSION_IN_EPS
from cnfp_torchrl.geometry.kinked_sum import KinkedSumBound


@dataclass(frozen=True, eq=False)
class WeightedL1Ball(KinkedSumBound):
    r"""The weighted L1 ball :math:`\{a : \sum_i |weights_i a_i| \le bound\}`.

    With joint velocities as weights and torques as actions it limits the power of all joints.

    Args:
        weights: ``(*batch, d)``, finite; zeros are allowed and leave their component free.
        bound: ``(*batch,)``, finite, 0 or more; at 0 nothing may be taken.
    """

    @staticmethod
    def slopes(weights: Tensor) -> tuple[Tensor, Tensor]:
        return weights.abs(), -weights.abs()

    def eroded(self, magnitude: Tensor | float = 1.0) -> Self:
        # The terms of two actions in the set differ by no more than twice the bound in sum, so the
        # rounding errors do not depend on the actions' size.
        eps = EROSION_IN_EPS * torch.finfo(self.dtype).eps
        return type(self)(self.weights, self.bound * (1 - 2 * eps), validate_args=False)
