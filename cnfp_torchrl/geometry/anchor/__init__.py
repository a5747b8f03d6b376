"""The anchor: which sets hold, by how much others give way, and a point well inside."""

from cnfp_torchrl.geometry.anchor.attempts import attempt_anchor
from cnfp_torchrl.geometry.anchor.depth import DEPTH, row_depths
from cnfp_torchrl.geometry.anchor.lexicographic import (
    LEEWAY,
    Begun,
    begin_anchor,
    chebyshev_center,
    continue_anchor,
    finish_anchor,
    lexicographic_anchor,
    relaxation_floor,
)
from cnfp_torchrl.geometry.anchor.search import Anchored

__all__ = [
    "DEPTH",
    "LEEWAY",
    "Anchored",
    "Begun",
    "attempt_anchor",
    "begin_anchor",
    "chebyshev_center",
    "continue_anchor",
    "finish_anchor",
    "lexicographic_anchor",
    "relaxation_floor",
    "row_depths",
]
