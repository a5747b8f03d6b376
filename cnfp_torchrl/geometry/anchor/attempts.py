"""Cheap attempts at the anchor: a fixed number of passes over all states, and no search."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from cnfp_torchrl.geometry.anchor.ascent import Ascent
from cnfp_torchrl.geometry.anchor.depth import bounds_of, row_depths
from cnfp_torchrl.geometry.constraint_set import ConstraintSet, broadcast_shape

STEPS = 4
"""The number of steps inwards; more would decide tighter states, which the search takes now."""

REFINEMENT = 5
"""The largest number of steps inwards where it is looked which states need more of them."""

SHARE = 0.3
"""The share of the best slack that is enough for an attempt."""


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
    depths = row_depths(sets)
    found = first_attempt(sets, depths, candidate)
    if steps:
        found = further_attempt(sets, depths, found, steps)
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


def first_attempt(
    sets: Sequence[ConstraintSet], depths: Sequence[Tensor], candidate: Tensor | None
) -> Attempt:
    """Try the middle of all bounding boxes, 0, and points between a candidate and the middle."""
    low, high = _bounding_box(sets)
    middle = (low + high) / 2
    points = [middle, torch.zeros_like(middle).clamp(low, high)]
    if candidate is not None:
        points += [torch.lerp(candidate, middle, share) for share in (0.0, 0.25, 0.5, 0.75)]
    # No point has more slack than the middle of all boxes has in the boxes.
    return _roomiest(sets, depths, points, (high - low).amin(-1) / 2)


def no_attempt(sets: Sequence[ConstraintSet]) -> Attempt:
    """Return the middle of all bounding boxes, untried: where steps inwards begin by trying it."""
    low, high = _bounding_box(sets)
    bounds, shape = bounds_of(sets), broadcast_shape(*(s.batch_shape for s in sets))
    middle = ((low + high) / 2).clamp(bounds.low, bounds.high).expand(*shape, bounds.dim)
    undecided = torch.zeros(shape, dtype=torch.bool, device=middle.device)
    return Attempt(middle, (high - low).amin(-1) / 2, undecided)


def _bounding_box(sets: Sequence[ConstraintSet]) -> tuple[Tensor, Tensor]:
    """Return bounds of all sets."""
    boxes = [constraint_set.bounding_box() for constraint_set in sets]
    low, high = boxes[0]
    for box in boxes[1:]:
        low, high = torch.maximum(low, box.low), torch.minimum(high, box.high)
    return low, high


def further_attempt(
    sets: Sequence[ConstraintSet], depths: Sequence[Tensor], before: Attempt, steps: int
) -> Attempt:
    """Take some steps inwards from where an attempt ended."""
    ascent = Ascent(sets, before.anchor, before.upper)
    ascent.run(steps)
    return _roomiest(sets, depths, [ascent.point, before.anchor], ascent.bound)


def refined_attempt(
    sets: Sequence[ConstraintSet], depths: Sequence[Tensor], before: Attempt
) -> Attempt:
    """Take steps inwards from where an attempt ended, in states that need them as many as needed.

    Args:
        sets: Sets of batch shapes that broadcast.
        depths: Depths of their rows (`row_depths`), ``(*batch, m)`` for each set.
        before: The attempt to start from, ``(*batch,)``.

    Returns:
        The attempts in all states, side by side.
    """
    ascent = Ascent(sets, before.anchor, before.upper)
    if not ascent.of.sees_all:
        return further_attempt(sets, depths, before, STEPS).select()
    largest = depths[0].amax(-1)
    for depth in depths[1:]:
        largest = torch.maximum(largest, depth.amax(-1))
    return Attempt(*ascent.run_until(REFINEMENT, SHARE, largest))


def select_states(
    sets: Sequence[ConstraintSet], depths: Sequence[Tensor], shape: torch.Size, index: Tensor
) -> tuple[list[ConstraintSet], list[Tensor]]:
    """Return sets and depths of some states, by their flat indices in a batch shape."""
    some = [depth.expand(*shape, depth.shape[-1]) for depth in depths]
    some = [depth.reshape(-1, depth.shape[-1])[index] for depth in some]
    return [s.select(shape, index) for s in sets], some


def _roomiest(
    sets: Sequence[ConstraintSet], depths: Sequence[Tensor], points: Sequence[Tensor], upper: Tensor
) -> Attempt:
    """Choose the points with the most slack beyond the largest depth of each set."""
    shape = broadcast_shape(*(s.batch_shape for s in sets), *(p.shape[:-1] for p in points))
    stacked = torch.stack([point.expand(*shape, point.shape[-1]) for point in points])
    slacks = [s.slack(stacked) for s in sets]
    room, slack = slacks[0] - depths[0].amax(-1), slacks[0]
    for each, depth in zip(slacks[1:], depths[1:], strict=True):
        room, slack = torch.minimum(room, each - depth.amax(-1)), torch.minimum(slack, each)
    room, best = room.nan_to_num(nan=-torch.inf).max(0, keepdim=True)
    slack = slack.gather(0, best).squeeze(0)
    # Not take_along_dim, with which an exported program would be one for a single batch size.
    index = best.unsqueeze(-1).expand(1, *shape, stacked.shape[-1])
    anchor = stacked.gather(0, index).squeeze(0)
    return Attempt(anchor, upper, (room.squeeze(0) >= 0) & (slack >= SHARE * upper))
