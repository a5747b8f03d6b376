"""Environments and the transforms that publish their constraints into the tensordict."""

from cnfp_torchrl.envs.action_guard import ActionGuard
from cnfp_torchrl.envs.centre import ConstraintCentre, constrain_env, constraint_bijectors
from cnfp_torchrl.envs.cost import ConstraintCost, constraint_names
from cnfp_torchrl.envs.dynamics import PointNavDynamics, State, Transition
from cnfp_torchrl.envs.geometry_transform import GeometryTransform
from cnfp_torchrl.envs.gymnasium_env import POINT_NAV_ID, PointNavGymnasiumEnv, register
from cnfp_torchrl.envs.layout import Layout
from cnfp_torchrl.envs.packed_states import PackedStates
from cnfp_torchrl.envs.penalty import RewardPenalty
from cnfp_torchrl.envs.point_nav import PointNavEnv
from cnfp_torchrl.envs.point_nav_geometry import BatteryGeometry, ObstacleGeometry
from cnfp_torchrl.envs.rendering import render_point_nav
from cnfp_torchrl.envs.sampled_geometry import SampledGeometry, constraints_to_sample
from cnfp_torchrl.envs.shortest_path import ShortestPath
from cnfp_torchrl.envs.visible_geometry import VisibleObstacleGeometry

register()

__all__ = [
    "POINT_NAV_ID",
    "ActionGuard",
    "BatteryGeometry",
    "ConstraintCentre",
    "ConstraintCost",
    "GeometryTransform",
    "Layout",
    "ObstacleGeometry",
    "PackedStates",
    "PointNavDynamics",
    "PointNavEnv",
    "PointNavGymnasiumEnv",
    "RewardPenalty",
    "SampledGeometry",
    "ShortestPath",
    "State",
    "Transition",
    "VisibleObstacleGeometry",
    "constrain_env",
    "constraint_bijectors",
    "constraint_names",
    "constraints_to_sample",
    "render_point_nav",
]
