r"""Cheap attempts at the anchor: a fixed number of passes over all states, and no search.

First points that need no arithmetic: the middle of all bounding boxes, the action 0, and those on
the way from a candidate to the middle. Then steps inwards: Newton steps towards the analytic center
of :math:`\{a : slack_j(a) \ge \tau\}`, where the level :math:`\tau` follows the smallest slack.

Weights :math:`\lambda \propto 1/(slack - \tau)` of the rows certify how good a point is. With
gradients g, for all x within the bounds

.. math:: \min_j slack_j(x) \le \sum_j \lambda_j slack_j(a) + \sum_j \lambda_j g_j \cdot (x - a),

and near the analytic center the second sum vanishes (weak duality of the linear program; Boyd and
Vandenberghe, Convex Optimization, 2004, section 11.2.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import torch
from torch import Tensor

from cnfp_torchrl.geometry.anchor.depth import bounds_of, row_depths
from cnfp_torchrl.geometry.anchor.program import Program
from cnfp_torchrl.geometry.box import Box
from cnfp_torchrl.geometry.constraint_set import ConstraintSet
from cnfp_torchrl.geometry.superlevel import Rows

STEPS = 5
"""Steps inwards: more decide tighter states, which the search takes otherwise."""

SHARE = 0.3
"""The share of the best slack with which an attempt is content."""

_LEVEL = 0.2
_NEAREST = 0.9


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
    bounds, depths = bounds_of(sets), row_depths(sets)
    boxes = _common_box(sets)
    middle = (boxes.low + boxes.high) / 2
    points = [middle, torch.minimum(torch.maximum(torch.zeros_like(middle), boxes.low), boxes.high)]
    if candidate is not None:
        ways = torch.broadcast_tensors(candidate, middle)
        points += [torch.lerp(*ways, share) for share in (0.0, 0.25, 0.5, 0.75)]
    rooms = torch.stack(torch.broadcast_tensors(*(_room(sets, depths, p)[0] for p in points)))
    slack, best = rooms.nan_to_num(nan=-torch.inf).max(0)
    stacked = torch.stack(torch.broadcast_tensors(*points))
    stacked = stacked.expand(*rooms.shape, stacked.shape[-1])
    anchor = stacked.take_along_dim(best[None, ..., None], 0).squeeze(0)
    # No point has more slack than the middle of all boxes has in the boxes.
    upper = (boxes.high - boxes.low).amin(-1) / 2
    if steps:
        moved, bound = _inwards(sets, bounds, anchor, steps)
        upper = torch.minimum(upper, bound)
        room = _room(sets, depths, moved)[0]
        better = room > slack
        anchor = torch.where(better.unsqueeze(-1), moved, anchor)
    room, slack = _room(sets, depths, anchor)
    return anchor, (room >= 0) & (slack >= SHARE * upper)


def _room(
    sets: Sequence[ConstraintSet], depths: Sequence[Tensor], point: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the least slack beyond the depth, and the least slack, ``(*batch,)`` each."""
    slacks = [each.row_slacks(point) for each in sets]
    rooms = [(slack - depth).amin(-1) for slack, depth in zip(slacks, depths, strict=True)]
    least = [slack.amin(-1) for slack in slacks]
    return (
        torch.stack(torch.broadcast_tensors(*rooms)).amin(0),
        torch.stack(torch.broadcast_tensors(*least)).amin(0),
    )


def _common_box(sets: Sequence[ConstraintSet]) -> Box:
    boxes = [each.bounding_box() for each in sets]
    low = torch.stack(torch.broadcast_tensors(*(box.low for box in boxes))).amax(0)
    high = torch.stack(torch.broadcast_tensors(*(box.high for box in boxes))).amin(0)
    return Box(low, high, validate_args=False)


def _inwards(
    sets: Sequence[ConstraintSet], bounds: Box, start: Tensor, steps: int
) -> tuple[Tensor, Tensor]:
    """Return points some steps inwards and upper bounds of the best slack."""
    shape, dim = start.shape[:-1], start.shape[-1]
    index = torch.arange(shape.numel(), device=start.device)
    flat = [each.select(shape, index) for each in sets]
    half = (flat[0].high - flat[0].low) / 2  # type: ignore[attr-defined]
    middle = (flat[0].high + flat[0].low) / 2  # type: ignore[attr-defined]
    slacks = _Slacks.of(flat, half)
    at = start.reshape(-1, dim)
    # In units of the bounds' half widths, about their middle.
    x = (at - middle) / half
    upper = half.amin(-1)
    best, most = at, torch.full_like(upper, -torch.inf)
    for step in range(steps + 1):
        slack, gradient = slacks.at(middle + half * x)
        least = slack.amin(-1)
        better = least > most
        best = torch.where(better.unsqueeze(-1), middle + half * x, best)
        most = torch.maximum(least, most)
        gap = (upper - least).clamp(min=0) * _LEVEL + torch.finfo(x.dtype).eps * half.amin(-1)
        inverse = (slack - (least - gap).unsqueeze(-1)).reciprocal()
        pull = torch.bmm(inverse.unsqueeze(-2), gradient).squeeze(-2)
        total = inverse.sum(-1)
        # The best slack is no larger than what the rows' mean may become within the bounds.
        reach = (pull.abs() - pull * x).sum(-1)
        bound = ((inverse * slack).sum(-1) + reach) / total
        upper = torch.minimum(upper, torch.where(bound.isnan(), upper, bound))
        if step == steps:
            break
        scaled = gradient * inverse.unsqueeze(-1)
        move = torch.linalg.solve_ex(scaled.mT @ scaled, pull.unsqueeze(-1))[0]
        fall = (scaled @ move).squeeze(-1).amin(-1)
        share = torch.where(fall < -_NEAREST, -_NEAREST / fall, 1.0)
        x = x + move.squeeze(-1) * share.unsqueeze(-1)
    return best.view(*shape, dim), upper.view(shape)


class _Slacks(NamedTuple):
    """Slacks of the inequalities that describe sets, and gradients in units of the half widths."""

    program: Program
    half: Tensor
    row_gradients: Tensor
    row_offsets: Tensor

    @classmethod
    def of(cls, sets: Sequence[ConstraintSet], half: Tensor) -> Self:
        parts = [part for each in sets if (part := each.superlevel()) is not None]
        program = Program.stack(parts, len(half))
        rates = torch.where(program.row_rates > 0, program.row_rates, 1.0)
        normals = program.rows / rates.unsqueeze(-1)
        # Rows that let every action pass never come near.
        far = half.amax(-1, keepdim=True) * 1e3
        free = program.row_weights == 0
        offsets = torch.where(free, far, program.row_offsets / rates)
        normals = torch.where(free.unsqueeze(-1), 0.0, normals)
        return cls(program, half, -normals, offsets)

    def at(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return slacks ``(B, M)`` and their gradients ``(B, M, d)``."""
        p = self.program
        slack = self.row_offsets + (self.row_gradients @ action.unsqueeze(-1)).squeeze(-1)
        slacks, gradients = [slack], [self.row_gradients]
        if p.cone_rates.shape[-1]:
            white = p.white(action)
            length = torch.linalg.vector_norm(white, dim=-1)
            slacks.append((p.cone_sizes - length) / p.cone_rates)
            unit = white / (length * p.cone_rates).clamp(min=torch.finfo(white.dtype).tiny)[..., None]
            gradients.append(-(p.matrices * unit.unsqueeze(-1)).sum(-2))
        if p.sum_rates.shape[-1]:
            side = torch.where(action.unsqueeze(-2) > 0, p.upper, p.lower)
            rates = torch.where(p.sum_rates > 0, p.sum_rates, 1.0)
            total = (side * action.unsqueeze(-2)).sum(-1)
            slacks.append((p.sum_sizes - total) / rates)
            gradients.append(-side / rates.unsqueeze(-1))
        return torch.cat(slacks, -1), torch.cat(gradients, -2) * self.half.unsqueeze(-2)
