"""Gymnasium wrappers that let any agent act within the constraints."""

from cnfp_torchrl.wrappers.constrained_actions import (
    ConstrainedActions,
    VectorConstrainedActions,
)

__all__ = ["ConstrainedActions", "VectorConstrainedActions"]
