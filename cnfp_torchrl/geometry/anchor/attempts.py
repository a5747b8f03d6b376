"""Cheap attempts at the anchor: a fixed number of passes over all states, and no search."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from cnfp_torchrl.geometry.anchor.ascent import Ascent
from cnfp_torchrl.geometry.anchor.depth import EROSIONS, bounds_of, depth_in_boxes, row_depths
from cnfp_torchrl.geometry.box import Box
from cnfp_torchrl.geometry.constraint_set import Bounds, ConstraintSet, broadcast_shape

STEPS = 4
"""The number of steps inwards; more would decide tighter states, which the search takes now."""

REFINEMENT = 5
"""The largest number of steps inwards where it is looked which states need more of them."""

SHARE = 0.3
"""The share of the best slack that is enough for an attempt."""

INWARDS = 0.33
"""The least share of the best slack that points next to sets' deepest ones keep from boxes."""


@torch.no_grad()
def attempt_anchor(
    sets: Sequence[ConstraintSet], candidate: Tensor | None = None, steps: int = STEPS
) -> tuple[Tensor, Tensor]:
    """Find anchors in states in which all sets hold together and a few passes show where.

    Computes in the dtype of the sets and reads no tensor on the host, so that it compiles and
    exports. A state left undecided is one for `lexicographic_anchor`.

    Args:
        sets: K + 1 sets in order of application; ``sets[0]`` is the finite box of action bounds.
        candidate: Points that may lie in all sets, such as a known safe action, ``(*batch, d)``.
        steps: The number of steps inwards, 0 or more.

    Returns:
        Points ``(*batch, d)``, and the flags of those that are anchors, boolean ``(*batch,)``: they
        have the depth of `row_depths` in every row of every set, and at least 0.3 of the best slack
        in all sets. Of non-convex sets a convex part counts.

    Raises:
        GeometryError: when the first set is no box.
    """
    found = first_attempt(sets, candidate)
    if steps:
        found = further_attempt(sets, found, steps)
    return found.anchor, found.decided


class Attempt(NamedTuple):
    """Points, upper bounds of the best slack, and whether the points are anchors."""

    anchor: Tensor
    upper: Tensor
    decided: Tensor

    def select(self, index: Tensor | None = None) -> Attempt:
        """Return some batch elements, by their flat indices, or all of them, side by side."""
        shape, dim = self.decided.shape, self.anchor.shape[-1]
        anchor = self.anchor.reshape(-1, dim)
        upper, decided = self.upper.expand(shape).reshape(-1), self.decided.reshape(-1)
        if index is None:
            return Attempt(anchor, upper, decided)
        return Attempt(anchor[index], upper[index], decided[index])

    def view(self, shape: torch.Size) -> Attempt:
        """Return what lies side by side in a batch shape."""
        anchor = self.anchor.view(*shape, self.anchor.shape[-1])
        return Attempt(anchor, self.upper.view(shape), self.decided.view(shape))


def first_attempt(sets: Sequence[ConstraintSet], candidate: Tensor | None = None) -> Attempt:
    r"""Try the middle of all bounding boxes, a point that sets of closed form agree on, and others.

    Where one set of closed form, such as a ball or a half-space, is all there is beside boxes, the
    points find the best slack t up to a share of :math:`1 / (1 + \sqrt d)`: no point of the boxes
    has more slack in that set than its deepest one, which loses :math:`\sqrt d\, s` at most by
    moving inwards by s in each component.

    Args:
        sets: Sets of batch shapes that broadcast, the first of them the box of action bounds.
        candidate: Points that may lie in all sets, ``(*batch, d)``.
    """
    bounds = bounds_of(sets)
    low, high = box = _bounding_box(bounds, sets)
    # No point has more slack than the middle of all boxes has in the boxes.
    upper = (high - low).amin(-1) / 2
    middle = torch.lerp(low, high, 0.5)
    points = [middle]
    deepest = []
    for constraint_set in sets[1:]:
        if (point := constraint_set.deepest_within(box)) is not None:
            upper = torch.minimum(upper, constraint_set.slack(point))
            deepest.append(point)
    if deepest:
        inwards = (upper * max(INWARDS, 1 / (1 + math.sqrt(box.low.shape[-1])))).unsqueeze(-1)
        wanted = deepest[0] if len(deepest) == 1 else torch.stack(deepest).mean(0)
        near = torch.clamp(wanted, low + inwards, high - inwards)
        # Half way to the middle there is often more room.
        points += [near, torch.lerp(near, middle, 0.5)]
    if candidate is not None:
        points += [candidate, torch.lerp(candidate, middle, 0.5)]
    if not all(map(_is_described, sets)):
        points.append(torch.zeros_like(middle).clamp(low, high))
    return _roomiest(bounds, sets, box, points, upper)


def _is_described(constraint_set: ConstraintSet) -> bool:
    """Tell whether steps inwards see all of a set, so that they make up for a first attempt."""
    described = type(constraint_set).superlevel is not ConstraintSet.superlevel
    return described and constraint_set.is_convex()


def _bounding_box(bounds: Box, sets: Sequence[ConstraintSet]) -> Bounds:
    """Return bounds of the action bounds and all sets behind them."""
    box = bounds.bounding_box()
    for constraint_set in sets[1:]:
        other = constraint_set.bounding_box()
        box = Bounds(torch.maximum(box.low, other.low), torch.minimum(box.high, other.high))
    return box


def further_attempt(sets: Sequence[ConstraintSet], before: Attempt, steps: int) -> Attempt:
    """Take some steps inwards from where an attempt ended."""
    ascent = Ascent(sets, before.anchor, before.upper)
    ascent.run(steps)
    bounds, points = bounds_of(sets), [ascent.point, before.anchor]
    return _roomiest(bounds, sets, _bounding_box(bounds, sets), points, ascent.bound)


def stepped_attempt(
    sets: Sequence[ConstraintSet], before: Attempt, steps: int = REFINEMENT
) -> Attempt:
    """Take the steps of `refined_attempt` in all states, of which those move that need them.

    Reads no tensor on the host. States that are left undecided stay as they were.

    Args:
        sets: Sets of batch shapes that broadcast, the first of them the box of action bounds.
        before: The attempt to start from, ``(*batch,)``.
        steps: The number of steps inwards.
    """
    if not steps_may_help(sets):
        return before
    depth = functools.reduce(torch.maximum, (depths.amax(-1) for depths in row_depths(sets)))
    ascent = Ascent(sets, before.anchor, before.upper)
    found = Attempt(*ascent.run_until(steps, SHARE, depth, reads=False)).view(before.decided.shape)
    is_new = (found.decided & ~before.decided).unsqueeze(-1)
    anchor = torch.where(is_new, found.anchor, before.anchor)
    return Attempt(anchor, before.upper, before.decided | found.decided)


def steps_may_help(sets: Sequence[ConstraintSet]) -> bool:
    """Tell whether steps inwards see all sets, and may decide states that a first attempt cannot.

    A first attempt decides all states in which boxes and one set of closed form hold together.
    """
    bounds, others = bounds_of(sets), [s for s in sets[1:] if not isinstance(s, Box)]
    if not all(map(_is_described, sets)):
        return False
    if len(others) > 1 or 1 / (1 + math.sqrt(bounds.dim)) < SHARE:
        return True
    return any(s.deepest_within(bounds.bounding_box()) is None for s in others)


def refined_attempt(sets: Sequence[ConstraintSet], before: Attempt, depth: Tensor) -> Attempt:
    """Take steps inwards from where an attempt ended, in states that need them as many as needed.

    Args:
        sets: Sets of batch shapes that broadcast.
        before: The attempt to start from, ``(*batch,)``.
        depth: The largest depth of an anchor in any row, ``(*batch,)``.

    Returns:
        The attempts in all states, side by side.
    """
    if all(s.is_convex() for s in sets) and bool((before.upper < -depth).all()):
        return before.select()
    ascent = Ascent(sets, before.anchor, before.upper)
    if not ascent.of.sees_all:
        return further_attempt(sets, before, STEPS).select()
    return Attempt(*ascent.run_until(REFINEMENT, SHARE, depth))


def _roomiest(
    bounds: Box,
    sets: Sequence[ConstraintSet],
    box: Bounds,
    points: Sequence[Tensor],
    upper: Tensor,
) -> Attempt:
    """Choose the points with the most slack beyond what an anchor needs.

    Args:
        bounds: The action bounds.
        sets: Sets of batch shapes that broadcast, the first of them the bounds.
        box: The bounds of all sets, in which all slacks in boxes are at least what they are in it.
        points: The points to choose from, ``(*batch, d)``.
        upper: Upper bounds of the best slack, ``(*batch,)``.
    """
    shape = broadcast_shape(*(s.batch_shape for s in sets), *(p.shape[:-1] for p in points))
    stacked = torch.stack([point.expand(*shape, point.shape[-1]) for point in points])
    # No box has a larger rounding error than the bounds, whose largest coordinate is theirs.
    needed = torch.maximum(SHARE * upper, depth_in_boxes(bounds))
    room = torch.minimum(box.high - stacked, stacked - box.low).amin(-1) - needed
    for constraint_set in sets[1:]:
        if not isinstance(constraint_set, Box):
            rounding = constraint_set.rounding(bounds.magnitude())
            largest = rounding.squeeze(-1) if rounding.shape[-1] == 1 else rounding.amax(-1)
            beyond = torch.maximum(needed, EROSIONS * largest)
            room = torch.minimum(room, constraint_set.slack(stacked) - beyond)
    # Not by `max` and its index, as gathering takes longer than choosing between two.
    (most, *rooms), (anchor, *others) = room.nan_to_num(nan=-torch.inf).unbind(), stacked.unbind()
    for room, point in zip(rooms, others, strict=True):
        anchor = torch.where((room > most).unsqueeze(-1), point, anchor)
        most = torch.maximum(most, room)
    return Attempt(anchor, upper, most >= 0)
