"""Anchors of intersections of sets, and which sets hold, by the lexicographic rule."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain

import torch
from torch import Tensor

from cnfp_torchrl.geometry.barrier import Best, maximize_slack
from cnfp_torchrl.geometry.box import Box
from cnfp_torchrl.geometry.constraint_set import ConstraintSet, GeometryError
from cnfp_torchrl.geometry.cutting_planes import maximize_slack_by_cuts
from cnfp_torchrl.geometry.slack_program import Program

MINIMUM_SLACK = 5e-5
"""The least slack, in action units, of an intersection that is worth holding.

Gauges about an anchor with slack h carry a relative error of eps |a| / h, in float32 some 1e-3 for
actions of size one at this slack; smaller is not much use. Larger would drop thin sets: in 32
dimensions the largest ball in a weighted L1 ball 1e-3 wide has a radius of 8.8e-5.
"""


@torch.no_grad()
def lexicographic_anchor(
    sets: Sequence[ConstraintSet],
    candidate: Tensor | None = None,
    minimum_slack: float = MINIMUM_SLACK,
) -> tuple[Tensor, Tensor]:
    r"""Find which sets can hold together in each state, and a point well inside those.

    :math:`S = A_0`; for k from the highest priority K down to 1: if S and :math:`A_k` have a common
    point with the minimum slack, :math:`S = S \cap A_k`, else :math:`A_k` is inactive in this
    state. A convex set is dropped only on a certified upper bound of the slack below the minimum.
    Of non-convex sets convex parts are tried: those of the most room, those near points that all
    convex sets have in common, and those near a point of what is kept so far. Slack is counted in
    sets eroded for rounding error twice: once for the actions, once for the anchor.

    Args:
        sets: K + 1 sets in order of application; ``sets[0]`` is the finite box of action bounds,
            which always holds, and the last has the highest priority.
        candidate: points that may lie in all sets, ``(*batch, d)``. Where one does, with the
            minimum slack, the anchor is found from it without a search, on its way to the middle of
            all boxes. Elsewhere, or with None, the anchor has at least half of the best slack.
        minimum_slack: in action units.

    Returns:
        The anchors ``(*batch, d)`` and the active flags, boolean ``(*batch, K + 1)``.

    Raises:
        GeometryError: when ``sets[0]`` is no box; where a search is needed, also when it is
            unbounded or a field has NaN in it.
    """
    if not sets or not isinstance(sets[0], Box):
        given = [type(each).__name__ for each in sets]
        raise GeometryError(f"sets[0]: expected the Box of action bounds, given sets {given}")
    magnitude = sets[0].magnitude()
    once = [each.eroded(magnitude) for each in sets]
    twice = [each.eroded(magnitude) for each in once]
    boxes = _common_box(twice)
    if candidate is None:
        # No point has more slack than the middle of all boxes has in the boxes.
        anchor = (boxes.low + boxes.high) / 2
        slack = _least_slack(twice, anchor)
        good = (slack >= minimum_slack) & (2 * slack >= boxes.slack(anchor))
        anchor = anchor.expand(*good.shape, -1)
    else:
        anchor, good = _from_candidate(once, twice, candidate, boxes, minimum_slack)
    active = good.unsqueeze(-1).expand(*good.shape, len(sets))
    if bool(good.all()):
        return anchor, active.clone()
    index = (~good).flatten().nonzero().squeeze(-1)
    hard = [each.select(good.shape, index) for each in twice]
    points, flags = _search(hard, minimum_slack)
    anchor = anchor.reshape(-1, anchor.shape[-1]).index_copy(0, index, points.to(anchor.dtype))
    active = active.reshape(-1, len(sets)).index_copy(0, index, flags)
    return anchor.view(*good.shape, -1), active.view(*good.shape, -1)


def chebyshev_center(
    sets: Sequence[ConstraintSet],
    active: Tensor | None = None,
    enough: float = MINIMUM_SLACK,
    share: float = 0.5,
    near: Tensor | None = None,
) -> Best:
    """Find points whose smallest slack in all sets is a large share of the best one.

    A batched interior-point method in float64. It stops early where the best slack is certainly
    below `enough`; then the upper bound says so, and the point is of no use. A set that does not
    describe its `superlevel` is cut out by linearizations of its slack, which takes longer. Of a
    non-convex set a convex part counts.

    Args:
        sets: sets of batch shape ``(B,)``, the first a finite box.
        active: which sets count, boolean ``(B, len(sets))``; None means all.
        enough: the smallest slack of interest, in action units.
        share: the share of the best slack that will do, below 1.
        near: of non-convex sets the parts near these points count, ``(B, d)``; None means those
            that `ConstraintSet.superlevel` describes.

    Returns:
        Actions ``(B, d)``, their slacks ``(B,)`` and upper bounds of the best slacks ``(B,)``.

    Raises:
        GeometryError: when the first set is no finite box, or a field has NaN in it.
        RuntimeError: when the search does not come to an end.
    """
    wide = [each.to(torch.float64) for each in sets]
    bounds = wide[0]
    if not isinstance(bounds, Box) or not bool((bounds.high - bounds.low).isfinite().all()):
        raise GeometryError("sets[0]: expected a finite Box of action bounds")
    for i, each in enumerate(wide):
        for name, field in each.fields().items():
            if bool(field.isnan().any()):
                raise GeometryError(f"sets[{i}], field '{name}': expected numbers, given NaN")
    if active is None:
        active = bounds.low.new_ones(*bounds.batch_shape, len(sets)).bool()
    start = (bounds.low + bounds.high) / 2
    scale = (bounds.high - bounds.low).mean(-1)
    parts = [each.superlevel() if near is None else each.part_near(near) for each in wide]
    described = [i for i, part in enumerate(parts) if part is not None]
    known = [part for part in parts if part is not None]
    problem = Program.stack(known, active[:, described])
    others = [i for i, part in enumerate(parts) if part is None]
    if not others:
        return maximize_slack(problem, start, scale, enough, share)
    return maximize_slack_by_cuts(
        problem, [wide[i] for i in others], active[:, others], start, scale, enough, share
    )


def _search(sets: Sequence[ConstraintSet], minimum_slack: float) -> tuple[Tensor, Tensor]:
    """Apply the lexicographic rule by the general method to sets of batch shape ``(B,)``."""
    bounds = sets[0]
    assert isinstance(bounds, Box)
    anchor = ((bounds.low + bounds.high) / 2).double()
    everything = torch.ones(len(anchor), len(sets), dtype=torch.bool, device=anchor.device)
    point, together = _common_point(sets, everything, anchor, minimum_slack)
    active = together.unsqueeze(-1).repeat(1, len(sets))
    active[:, 0] = True
    index = (~together).nonzero().squeeze(-1)
    if not len(index):
        return point, active
    sets = [each.select(together.shape, index) for each in sets]
    chosen, anchor = active[index], anchor[index]
    for k in range(len(sets) - 1, 0, -1):
        trial = chosen.clone()
        trial[:, k] = True
        found, fits = _common_point(sets, trial, anchor, minimum_slack)
        chosen[:, k] = fits
        anchor = torch.where(fits.unsqueeze(-1), found, anchor)
    return point.index_copy(0, index, anchor), active.index_copy(0, index, chosen)


def _common_point(
    sets: Sequence[ConstraintSet], active: Tensor, kept: Tensor, minimum_slack: float
) -> tuple[Tensor, Tensor]:
    """Return points well inside all active sets of a batch ``(B,)``, and where there are such.

    Args:
        sets: the first are the action bounds.
        active: boolean ``(B, len(sets))``.
        kept: points of the sets that are kept so far, ``(B, d)``.
        minimum_slack: of the points.
    """
    best = chebyshev_center(sets, active, minimum_slack)
    point, fits = best.action, best.upper_bound >= minimum_slack
    convex = [type(each).part_near is ConstraintSet.part_near for each in sets]
    if all(convex) or bool(fits.all()):
        return point, fits
    of_convex = active & torch.tensor(convex, device=active.device)
    relaxed = chebyshev_center(sets, of_convex, minimum_slack)
    possible = relaxed.upper_bound >= minimum_slack
    around = _around(relaxed.action, sets, of_convex)
    for near in chain((relaxed.action, kept), around):
        index = (possible & ~fits).nonzero().squeeze(-1)
        if not len(index):
            break
        hard = [each.select(fits.shape, index) for each in sets]
        best = chebyshev_center(hard, active[index], minimum_slack, near=near[index])
        point = point.index_copy(0, index, best.action)
        fits = fits.index_copy(0, index, best.upper_bound >= minimum_slack)
    return point, fits


def _around(point: Tensor, sets: Sequence[ConstraintSet], active: Tensor) -> Iterator[Tensor]:
    """Yield points ``(B, d)`` half of the way out of the active sets, along each axis."""
    for axis in torch.eye(point.shape[-1], dtype=point.dtype, device=point.device):
        for way in (axis.expand_as(point), -axis.expand_as(point)):
            gauges = torch.stack([each.to(point.dtype).gauge(way, point) for each in sets], -1)
            gauge = torch.where(active, gauges, 0.0).amax(-1, keepdim=True)
            yield point + way * (0.5 / gauge)


def _from_candidate(
    once: Sequence[ConstraintSet],
    twice: Sequence[ConstraintSet],
    point: Tensor,
    boxes: Box,
    minimum_slack: float,
) -> tuple[Tensor, Tensor]:
    """Move from points with enough slack towards the middle of all boxes, half of the way out."""
    good = _least_slack(twice, point) >= minimum_slack
    point = point.expand(*good.shape, -1)
    way = (boxes.low + boxes.high) / 2 - point
    gauges = [each.gauge(way, point) for each in once]
    gauge = torch.stack(torch.broadcast_tensors(*gauges)).amax(0)
    moved = point + way * (0.5 / gauge).clamp(max=1).unsqueeze(-1)
    # In convex sets at least half of the slack is left; a set of another shape may have a corner
    # beside the way, and half of little may be too little.
    roomy = _least_slack(twice, moved) >= minimum_slack
    return torch.where((good & roomy).unsqueeze(-1), moved, point), good


def _least_slack(sets: Sequence[ConstraintSet], point: Tensor) -> Tensor:
    slacks = torch.broadcast_tensors(*(each.slack(point) for each in sets))
    return torch.stack(slacks).amin(0)


def _common_box(sets: Sequence[ConstraintSet]) -> Box:
    boxes = [each for each in sets if isinstance(each, Box)]
    low = torch.stack(torch.broadcast_tensors(*(box.low for box in boxes))).amax(0)
    high = torch.stack(torch.broadcast_tensors(*(box.high for box in boxes))).amin(0)
    return Box(low, high, validate_args=False)
