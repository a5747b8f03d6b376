r"""The allowed accelerations of a unicycle: one half-space for each ellipse.

Let c be the point ahead of the axle, :math:`\delta` its offset from an ellipse's center in units
of the squared half-axes, and :math:`h = \delta \cdot (c - m) - 1`. The barrier
:math:`\psi = \dot h + \kappa h` is kept by :math:`\dot\psi \ge -\alpha \psi`, which is linear
in the accelerations.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from cnfp_torchrl.envs import GeometryTransform
from cnfp_torchrl.geometry import HalfSpaces
from cnfp_torchrl.tasks.safe_control.unicycle import Problem

MARGIN = 1e-9
"""The share of a row's terms by which it is moved inwards: more than rounding in float64."""


class BarrierGeometry(GeometryTransform):
    """The accelerations that keep all barriers, as the half-spaces of `barrier_rows` in float32.

    Args:
        name: The constraint's name.
        problem: The sizes; None takes the published ones.
        kwargs: Further options of `GeometryTransform`.
    """

    def __init__(
        self, name: str = "barriers", problem: Problem | None = None, **kwargs: Any
    ) -> None:
        super().__init__(name, ["state"], **kwargs)
        self.problem = Problem() if problem is None else problem

    def constraint_set(self, tensordict: TensorDictBase) -> HalfSpaces:
        """Return the half-spaces, one for each ellipse."""
        return barrier_rows(self.problem, tensordict.get("state")).to(torch.float32)


def barrier_rows(problem: Problem, state: Tensor) -> HalfSpaces:
    """Return the accelerations that keep all barriers.

    Args:
        problem: The sizes.
        state: States ``(*batch, 5)``, float64.
    """
    x, y, theta, speed, turn = state.unbind(-1)
    forward = torch.stack([theta.cos(), theta.sin()], -1)
    left = torch.stack([-theta.sin(), theta.cos()], -1)
    point = torch.stack([x, y], -1) + problem.ahead * forward
    speed, turn = speed.unsqueeze(-1), turn.unsqueeze(-1)
    velocity = speed * forward + problem.ahead * turn * left
    drift = speed * turn * left - problem.ahead * turn.square() * forward
    normals, offsets = [], []
    for center_x, center_y, *axes in problem.ellipses:
        weight = 1 / state.new_tensor(axes).square()
        apart = point - state.new_tensor((center_x, center_y))
        offset = 2 * weight * apart
        value = (weight * apart.square()).sum(-1) - 1
        rate = (offset * velocity).sum(-1)
        gathers = 2 * (weight * velocity.square()).sum(-1) + (offset * drift).sum(-1)
        bound = gathers + problem.kappa * rate
        bound = bound + problem.alpha * (rate + problem.kappa * value)
        along = [(offset * forward).sum(-1), problem.ahead * (offset * left).sum(-1)]
        normals.append(-torch.stack(along, -1))
        size = gathers.abs() + (problem.kappa + problem.alpha) * rate.abs() + value.abs() + 1
        offsets.append(bound - MARGIN * size.detach())
    return HalfSpaces(torch.stack(normals, -2), torch.stack(offsets, -1), validate_args=False)
