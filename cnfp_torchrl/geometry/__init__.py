"""Sets of allowed actions and their intersections: containment, slack, gauges, anchors."""

from cnfp_torchrl.geometry.anchor import (
    DEPTH,
    LEEWAY,
    Anchored,
    Begun,
    attempt_anchor,
    begin_anchor,
    chebyshev_center,
    continue_anchor,
    finish_anchor,
    lexicographic_anchor,
    relaxation_floor,
    row_depths,
)
from cnfp_torchrl.geometry.balls import Ball, Ellipsoid, TaskSpaceBall
from cnfp_torchrl.geometry.box import (
    Box,
    gauge_of_sides,
    require_action_bounds,
    sides,
)
from cnfp_torchrl.geometry.constraint_set import (
    EROSION_IN_EPS,
    Bounds,
    ConstraintSet,
    Evidence,
    Gauge,
    GeometryError,
    are_within,
    broadcast_shape,
    extremes,
    largest_value,
)
from cnfp_torchrl.geometry.half_spaces import HalfSpaces
from cnfp_torchrl.geometry.norms import component_sum, length, power_of_two
from cnfp_torchrl.geometry.projection import project, project_onto_intersection, settled
from cnfp_torchrl.geometry.region import Region, scaled_direction
from cnfp_torchrl.geometry.superlevel import Cone, KinkedSum, Rows, Superlevel
from cnfp_torchrl.geometry.visible_region import VisibleRegion
from cnfp_torchrl.geometry.weighted_sums import PositivePart, WeightedL1Ball

__all__ = [
    "DEPTH",
    "EROSION_IN_EPS",
    "LEEWAY",
    "Anchored",
    "Ball",
    "Begun",
    "Bounds",
    "Box",
    "Cone",
    "ConstraintSet",
    "Ellipsoid",
    "Evidence",
    "Gauge",
    "GeometryError",
    "HalfSpaces",
    "KinkedSum",
    "PositivePart",
    "Region",
    "Rows",
    "Superlevel",
    "TaskSpaceBall",
    "VisibleRegion",
    "WeightedL1Ball",
    "are_within",
    "attempt_anchor",
    "begin_anchor",
    "broadcast_shape",
    "chebyshev_center",
    "component_sum",
    "continue_anchor",
    "extremes",
    "finish_anchor",
    "gauge_of_sides",
    "largest_value",
    "length",
    "lexicographic_anchor",
    "power_of_two",
    "project",
    "project_onto_intersection",
    "relaxation_floor",
    "require_action_bounds",
    "row_depths",
    "scaled_direction",
    "settled",
    "sides",
]
