"""Constrained 2D point navigation, the task of the paper: environment, geometry, pictures."""

from cnfp_torchrl.tasks.point_nav.baselines import ShortestPathPolicy
from cnfp_torchrl.tasks.point_nav.dynamics import PointNavDynamics, State, Transition
from cnfp_torchrl.tasks.point_nav.env import PointNavEnv
from cnfp_torchrl.tasks.point_nav.geometry import (
    BatteryGeometry,
    ObstacleGeometry,
    VisibleObstacleGeometry,
)
from cnfp_torchrl.tasks.point_nav.gymnasium_env import POINT_NAV_ID, PointNavGymnasiumEnv, register
from cnfp_torchrl.tasks.point_nav.layout import Layout
from cnfp_torchrl.tasks.point_nav.rendering import render_point_nav
from cnfp_torchrl.tasks.point_nav.shortest_path import ShortestPath

register()

__all__ = [
    "POINT_NAV_ID",
    "BatteryGeometry",
    "Layout",
    "ObstacleGeometry",
    "PointNavDynamics",
    "PointNavEnv",
    "PointNavGymnasiumEnv",
    "ShortestPath",
    "ShortestPathPolicy",
    "State",
    "Transition",
    "VisibleObstacleGeometry",
    "render_point_nav",
]
