"""Transforms that publish an environment's constraints into the tensordict."""

from cnfp_torchrl.envs.action_guard import ActionGuard
from cnfp_torchrl.envs.anchor_transform import (
    ConstraintAnchor,
    constrain_env,
    constraint_bijectors,
)
from cnfp_torchrl.envs.cost import ConstraintCost, constraint_names
from cnfp_torchrl.envs.geometry_transform import GeometryTransform
from cnfp_torchrl.envs.penalty import RewardPenalty

__all__ = [
    "ActionGuard",
    "ConstraintAnchor",
    "ConstraintCost",
    "GeometryTransform",
    "RewardPenalty",
    "constrain_env",
    "constraint_bijectors",
    "constraint_names",
]
