"""The least depth of an anchor in every set, which is the resolution of all decisions."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from cnfp_torchrl.geometry.box import Box
from cnfp_torchrl.geometry.constraint_set import EROSION_IN_EPS, ConstraintSet, GeometryError

DEPTH = 2.5e-5
"""The least slack of an anchor in every set, as a share of the smallest width of the bounds.

Gauges about an anchor with slack h carry a relative error of eps ``|a|`` / h, in float32 some 1e-3
for actions of the size of the bounds at this slack; smaller is not much use. Larger would relax
thin sets that can hold: in 32 dimensions the largest ball in a weighted L1 ball 1e-3 wide has a
radius of 8.8e-5.
"""

EROSIONS = 8.0
"""The least slack of an anchor in a set, in erosions of that set.

Some are spent on rounding of the actions, of the anchor and of the amounts, in a set that
relaxation may have made twice as large.
"""


def bounds_of(sets: Sequence[ConstraintSet]) -> Box:
    """Return the action bounds, which come first.

    Raises:
        GeometryError: when the first set is no box, or another no set of as many components.
    """
    bounds = next(iter(sets), None)
    if not isinstance(bounds, Box):
        given = [type(constraint_set).__name__ for constraint_set in sets]
        raise GeometryError(f"sets[0]: expected the Box of action bounds, given sets {given}")
    for stage, given_set in enumerate(sets):
        if not isinstance(given_set, ConstraintSet) or given_set.dim != bounds.dim:
            is_set = isinstance(given_set, ConstraintSet)
            size = f" of {given_set.dim} components" if is_set else ""
            raise GeometryError(
                f"sets[{stage}]: expected a ConstraintSet of actions with {bounds.dim} components, "
                f"as the action bounds have, given {type(given_set).__name__}{size}"
            )
    return bounds


def depth_in_boxes(bounds: Box) -> Tensor:
    """Return the depth that the anchor has in each row of a box, at most, ``(*batch,)``.

    It is that of the action bounds: in no box are there larger coordinates of actions.
    """
    largest = EROSIONS * EROSION_IN_EPS * torch.finfo(bounds.dtype).eps
    return torch.maximum(DEPTH * bounds.smallest_width(), largest * bounds.magnitude())


def row_depths(sets: Sequence[ConstraintSet]) -> list[Tensor]:
    r"""Return the depth that the anchor has in each row of each set, ``(*batch, m)`` a set.

    :math:`h = \max(DEPTH \cdot width, EROSIONS \cdot erosion)`, in units of the set's slack: the
    width is that of the action bounds, the erosion what `ConstraintSet.eroded` takes off the row.

    Args:
        sets: Sets, the first of them the box of action bounds.
    """
    bounds = bounds_of(sets)
    least = (DEPTH * bounds.smallest_width()).unsqueeze(-1)
    magnitude = bounds.magnitude()
    return [torch.maximum(EROSIONS * s.rounding(magnitude), least) for s in sets]
