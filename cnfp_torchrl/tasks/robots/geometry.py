r"""The allowed actions of robots: limits of power, of effort at bent joints, of the actions' rate.

With :math:`\omega` the velocities of the driven joints and :math:`\theta` their angles, the last d
of the simulator's coordinates. Power and effort: Kasaura et al. 2023, "Benchmarking actor-critic
deep reinforcement learning algorithms for robotics control with action constraints", arXiv
2304.08743, there on observations, whose velocities some robots clip at 10: limits of the true
velocities are at least as tight. Rates: Liao et al. 2026, arXiv 2605.04185.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

from cnfp_torchrl.envs import GeometryTransform
from cnfp_torchrl.geometry import Box, ConstraintSet, PositivePart, TaskSpaceBall, WeightedL1Ball
from cnfp_torchrl.keys import PREVIOUS_ACTION_KEY


class JointLimit(GeometryTransform):
    """A limit that depends on the driven joints.

    Args:
        name: The constraint's name.
        limit: The largest value that is allowed, above 0.
        joints: The number d of driven joints, the last d coordinates.
        key: The key of the coordinates or velocities, ``(*batch, n)``, n >= d; None takes those
            that the limit is of, ``usual_key``.
        kwargs: Further options of `GeometryTransform`: ``margin`` and ``resolution``.

    Raises:
        ValueError: for a limit that is not positive, and without joints.
    """

    usual_key: ClassVar[str]
    """The simulator's own coordinates or velocities, by which it is limited."""

    def __init__(
        self, name: str, limit: float, joints: int, key: str | None = None, **kwargs: Any
    ) -> None:
        if not 0 < limit < float("inf"):
            raise ValueError(f"{name}.limit: expected a number > 0, given {limit}")
        if joints < 1:
            raise ValueError(f"{name}.joints: expected a number >= 1, given {joints}")
        super().__init__(name, [key or self.usual_key], **kwargs)
        self.limit, self.joints = limit, joints

    def of_joints(self, tensordict: TensorDictBase) -> Tensor:
        """Return the entries of the driven joints in float32, as actions are, ``(*batch, d)``."""
        return tensordict.get(self.in_keys[0])[..., -self.joints :].float()


class PowerLimit(JointLimit):
    r"""A limit of the power of all joints, :math:`\sum_i |\omega_i a_i| \le limit`.

    Publishes the zero action as a safe one.

    Args:
        name: The constraint's name.
        limit: The largest power that is allowed, above 0.
        joints: The number d of driven joints, the last d velocities.
        key: The key of the velocities, ``(*batch, n)``, n >= d.
        kwargs: Further options of `GeometryTransform`.
    """

    usual_key = "qvel"

    def constraint_set(self, tensordict: TensorDictBase) -> ConstraintSet:
        """Return the actions that take no more power than the limit."""
        velocities = self.of_joints(tensordict)
        return WeightedL1Ball(velocities, velocities.new_tensor(self.limit), validate_args=False)

    def safe_action(self, tensordict: TensorDictBase, allowed: ConstraintSet) -> Tensor:
        """Return no torque at all."""
        return torch.zeros_like(allowed.fields()["weights"])


class DrawnPowerLimit(PowerLimit):
    r"""A limit of the power that joints draw, :math:`\sum_i \max(\omega_i a_i, 0) \le limit`.

    What braking joints return does not count. Arguments as those of `PowerLimit`.
    """

    def constraint_set(self, tensordict: TensorDictBase) -> ConstraintSet:
        """Return the actions that draw no more power than the limit."""
        velocities = self.of_joints(tensordict)
        return PositivePart(velocities, velocities.new_tensor(self.limit), validate_args=False)


class BentEffortLimit(JointLimit):
    r"""A limit of the effort at bent joints, :math:`\sum_i a_i^2 \sin^2\theta_i \le limit`.

    An ellipsoid along the axes, unbounded in the joints that are straight.

    Args:
        name: The constraint's name.
        limit: The largest sum that is allowed, above 0.
        joints: The number d of driven joints, the last d coordinates.
        key: The key of the coordinates, ``(*batch, n)``, n >= d.
        kwargs: Further options of `GeometryTransform`.
    """

    usual_key = "qpos"

    def constraint_set(self, tensordict: TensorDictBase) -> ConstraintSet:
        """Return the actions whose effort is within the limit."""
        sines = self.of_joints(tensordict).sin()
        radius = sines.new_tensor(self.limit**0.5)
        return TaskSpaceBall(
            torch.diag_embed(sines), torch.zeros_like(sines), radius, validate_args=False
        )


class RateLimit(GeometryTransform):
    r"""A limit of how fast actions change, :math:`|a_i - a^{before}_i| \le limits_i`.

    Needs `cnfp_torchrl.envs.PreviousAction`.

    Args:
        name: The constraint's name.
        limits: The largest change in a step that is allowed, of each component, above 0.
        key: The key of the previous action, ``(*batch, d)``.
        kwargs: Further options of `GeometryTransform`.

    Raises:
        ValueError: for a limit that is not positive.
    """

    def __init__(
        self,
        name: str,
        limits: Sequence[float],
        key: str = PREVIOUS_ACTION_KEY,
        **kwargs: Any,
    ) -> None:
        if not all(0 < limit < float("inf") for limit in limits):
            raise ValueError(f"{name}.limits: expected numbers > 0, given {list(limits)}")
        super().__init__(name, [key], **kwargs)
        self.register_buffer("limits", torch.tensor(list(limits)))

    def constraint_set(self, tensordict: TensorDictBase) -> Box:
        """Return the actions within reach of the previous one."""
        action = tensordict.get(self.in_keys[0])
        limits = self.limits.to(action)
        return Box(action - limits, action + limits, validate_args=False)
