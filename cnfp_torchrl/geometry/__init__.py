"""Sets of allowed actions and their intersections: containment, slack, gauges, anchors."""

from cnfp_torchrl.geometry.anchors import MINIMUM_SLACK, chebyshev_center, lexicographic_anchor
from cnfp_torchrl.geometry.ball import Ball
from cnfp_torchrl.geometry.box import Box
from cnfp_torchrl.geometry.constraint_set import EROSION_IN_EPS, ConstraintSet, GeometryError
from cnfp_torchrl.geometry.ellipsoid import Ellipsoid
from cnfp_torchrl.geometry.half_spaces import HalfSpaces
from cnfp_torchrl.geometry.positive_part import PositivePart
from cnfp_torchrl.geometry.projection import project, project_onto_intersection
from cnfp_torchrl.geometry.region import Region
from cnfp_torchrl.geometry.superlevel import Cone, KinkedSum, Rows, Superlevel
from cnfp_torchrl.geometry.task_space_ball import TaskSpaceBall
from cnfp_torchrl.geometry.visible_or_box import VisibleOrBox
from cnfp_torchrl.geometry.visible_region import VisibleRegion
from cnfp_torchrl.geometry.weighted_l1_ball import WeightedL1Ball

__all__ = [
    "EROSION_IN_EPS",
    "MINIMUM_SLACK",
    "Ball",
    "Box",
    "Cone",
    "ConstraintSet",
    "Ellipsoid",
    "GeometryError",
    "HalfSpaces",
    "KinkedSum",
    "PositivePart",
    "Region",
    "Rows",
    "Superlevel",
    "TaskSpaceBall",
    "VisibleOrBox",
    "VisibleRegion",
    "WeightedL1Ball",
    "chebyshev_center",
    "lexicographic_anchor",
    "project",
    "project_onto_intersection",
]
