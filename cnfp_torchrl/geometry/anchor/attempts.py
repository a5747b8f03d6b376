"""Cheap attempts at the anchor: a fixed number of passes over all states, and no search."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from cnfp_torchrl.geometry.anchor.ascent import Ascent
from cnfp_torchrl.geometry.anchor.depth import row_depths
from cnfp_torchrl.geometry.constraint_set import ConstraintSet, broadcast_shape

STEPS = 6
"""Steps inwards: more decide tighter states, which the search takes otherwise."""

REFINEMENTS = (4, 3, 5)
"""Steps inwards between looks at which states need more of them."""

SHARE = 0.3
"""The share of the best slack with which an attempt is content."""


@torch.no_grad()
def attempt_anchor(
    sets: Sequence[ConstraintSet], candidate: Tensor | None = None, steps: int = STEPS
) -> tuple[Tensor, Tensor]:
    """Find anchors where all sets hold together and a few passes tell where.

    Tensors alone, without a look at their values: it compiles and exports. In the dtype of the
    sets. An undecided state says nothing: `lexicographic_anchor` decides it.

    Args:
        sets: K + 1 sets in order of application; ``sets[0]`` is the finite box of action bounds.
        candidate: points that may lie in all sets, such as a known safe action, ``(*batch, d)``.
        steps: the number of steps inwards, 0 or more.

    Returns:
        The anchors ``(*batch, d)``, and whether they do, boolean ``(*batch,)``: in every row of
        every set they have the depth that it asks for (`row_depths`), and at least 0.3 of the best
        slack in all sets. Of non-convex sets a convex part counts for that.

    Raises:
        GeometryError: when the first set is no box.
    """
    depths = row_depths(sets)
    found = first_attempt(sets, depths, candidate)
    if steps:
        found = further_attempt(sets, depths, found, steps)
    return found.anchor, found.decided


class Attempt(NamedTuple):
    """Points, upper bounds of the best slack, and whether the points will do, ``(*batch, ...)``."""

    anchor: Tensor
    upper: Tensor
    decided: Tensor

    def select(self, index: Tensor) -> Attempt:
        """Return some of the batch elements, by their flat indices."""
        shape, dim = self.decided.shape, self.anchor.shape[-1]
        return Attempt(
            self.anchor.reshape(-1, dim)[index],
            self.upper.expand(shape).reshape(-1)[index],
            self.decided.reshape(-1)[index],
        )


def first_attempt(
    sets: Sequence[ConstraintSet], depths: Sequence[Tensor], candidate: Tensor | None
) -> Attempt:
    """Try the middle of all bounding boxes, the action 0, and a candidate on its way there."""
    boxes = [each.bounding_box() for each in sets]
    low = torch.stack(torch.broadcast_tensors(*(box.low for box in boxes))).amax(0)
    high = torch.stack(torch.broadcast_tensors(*(box.high for box in boxes))).amin(0)
    middle = (low + high) / 2
    points = [middle, torch.zeros_like(middle).clamp(low, high)]
    if candidate is not None:
        points += [torch.lerp(candidate, middle, share) for share in (0.0, 0.25, 0.5, 0.75)]
    # No point has more slack than the middle of all boxes has in the boxes.
    return _roomiest(sets, depths, points, (high - low).amin(-1) / 2)


def further_attempt(
    sets: Sequence[ConstraintSet], depths: Sequence[Tensor], before: Attempt, steps: int
) -> Attempt:
    """Go on with some steps inwards."""
    ascent = Ascent(sets, before.anchor, before.upper)
    ascent.run(steps)
    return _roomiest(sets, depths, [ascent.point, before.anchor], ascent.bound)


def refined_attempt(
    sets: Sequence[ConstraintSet], depths: Sequence[Tensor], before: Attempt
) -> Attempt:
    """Go on with steps inwards, and look now and then which states need more of them.

    Args:
        sets: of batch shape ``(B,)``, as is all else.
        depths: that their rows ask for.
        before: where to begin.
    """
    anchor, upper, decided = (each.clone() for each in before)
    left = torch.arange(len(decided), device=decided.device)
    for steps in REFINEMENTS:
        ascent = Ascent(sets, before.anchor, before.upper)
        if ascent.sees_all:
            largest = torch.stack([depth.amax(-1) for depth in depths]).amax(0)
            deep = ascent.run_until(steps, SHARE, largest)
            found = Attempt(ascent.point, ascent.bound, deep)
            impossible = found.upper < -largest
        else:
            found = further_attempt(sets, depths, before, steps)
            impossible = torch.zeros_like(found.decided)
        anchor[left], upper[left], decided[left] = found
        hard = (~found.decided & ~impossible).nonzero().squeeze(-1)
        if not len(hard):
            break
        if len(hard) < len(left):
            sets = [each.select(found.decided.shape, hard) for each in sets]
            depths = [each[hard] for each in depths]
            left, found = left[hard], found.select(hard)
        before = found
    return Attempt(anchor, upper, decided)


def _roomiest(
    sets: Sequence[ConstraintSet], depths: Sequence[Tensor], points: Sequence[Tensor], upper: Tensor
) -> Attempt:
    """Choose those of some points that have most slack beyond the depth."""
    shape = broadcast_shape(*(each.batch_shape for each in sets), *(p.shape[:-1] for p in points))
    stacked = torch.stack([point.expand(*shape, point.shape[-1]) for point in points])
    slacks = [each.row_slacks(stacked) for each in sets]
    rooms = [(slack - depth).amin(-1) for slack, depth in zip(slacks, depths, strict=True)]
    room, slack = (
        torch.stack(torch.broadcast_tensors(*each)).amin(0)
        for each in (rooms, [slack.amin(-1) for slack in slacks])
    )
    room, best = room.nan_to_num(nan=-torch.inf).max(0, keepdim=True)
    slack = slack.gather(0, best).squeeze(0)
    anchor = stacked.take_along_dim(best.unsqueeze(-1), 0).squeeze(0)
    return Attempt(anchor, upper, (room.squeeze(0) >= 0) & (slack >= SHARE * upper))
