"""The judges of the robots' constraints: in float64, without tolerance.

They share nothing with the geometry. Which coordinates a motor drives they take from the
simulator's model, and they read the simulator's memory, not an observation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


class Judge(Protocol):
    """Tell whether an action violates a constraint in the state that the simulator is in."""

    def __call__(self, model: Any, data: Any, action: Vector) -> bool:
        """Judge an action before it is executed.

        Args:
            model: The simulator's ``MjModel``.
            data: The simulator's ``MjData``, in the state in which the action is taken.
            action: The action, ``(d,)``, as the simulator will execute it.
        """
        ...


@dataclass(frozen=True)
class PowerJudge:
    r"""More than the limit in all, :math:`\sum_i |\omega_i a_i| > limit`.

    Args:
        limit: The largest power that is allowed.
    """

    limit: float

    def __call__(self, model: Any, data: Any, action: Vector) -> bool:
        return bool(np.abs(_joint_velocities(model, data) * action).sum() > self.limit)


@dataclass(frozen=True)
class DrawnPowerJudge:
    r"""More than the limit drawn, :math:`\sum_i \max(\omega_i a_i, 0) > limit`.

    Args:
        limit: The largest power that is allowed.
    """

    limit: float

    def __call__(self, model: Any, data: Any, action: Vector) -> bool:
        power = _joint_velocities(model, data) * action
        return bool(power[power > 0].sum() > self.limit)


@dataclass(frozen=True)
class BentEffortJudge:
    r"""More than the limit at bent joints, :math:`\sum_i a_i^2 \sin^2\theta_i > limit`.

    Args:
        limit: The largest sum that is allowed.
    """

    limit: float

    def __call__(self, model: Any, data: Any, action: Vector) -> bool:
        angles = data.qpos[model.jnt_qposadr[model.actuator_trnid[:, 0]]]
        return bool(np.square(action * np.sin(angles)).sum() > self.limit)


@dataclass(frozen=True)
class RateJudge:
    r"""A change beyond the limit in any component, :math:`|a_i - a^{before}_i| > limit_i`.

    Args:
        limits: The largest change that is allowed in a step, of each component.
    """

    limits: Sequence[float]

    def __call__(self, model: Any, data: Any, action: Vector) -> bool:
        # After a reset the controls are 0.
        return bool((np.abs(action - data.ctrl) > np.asarray(self.limits)).any())


def _joint_velocities(model: Any, data: Any) -> Vector:
    """Return the velocities of the joints that the motors drive, in the motors' order."""
    return data.qvel[model.jnt_dofadr[model.actuator_trnid[:, 0]]]
