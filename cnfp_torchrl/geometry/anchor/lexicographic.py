r"""The lexicographic rule: which sets hold, by how much the others give way, and the anchor.

For k from the highest priority down, with a depth :math:`h_k` that every set keeps
(`cnfp_torchrl.geometry.anchor.depth`),

.. math:: S = \{a : slack_j(a) \ge h_j - \rho_j \text{ for the bounds and all } j > k\}, \quad
          \rho_k = \min_{a \in S} \max(0, h_k - slack_k(a)).

This is hierarchical optimization as known from robot control (Kanoun et al. 2011, Escande et al.
2014). Because the minimum is taken over S and not over the region itself, room of depth h is left
however many sets give way. The rows of one set are relaxed one by one, by lexicographic minimax:
the rows that keep the smallest slack from growing give way, then the others are decided without
them, so that one impossible row loosens no other row that can hold beside it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from cnfp_torchrl.geometry.anchor.attempts import attempt_anchor
from cnfp_torchrl.geometry.anchor.depth import bounds_of, row_depths, smallest_width
from cnfp_torchrl.geometry.anchor.interior_point import Best
from cnfp_torchrl.geometry.anchor.intersection import Intersection
from cnfp_torchrl.geometry.anchor.search import PRECISION, Anchored, Search
from cnfp_torchrl.geometry.constraint_set import ConstraintSet

LEEWAY = 1e-3
"""By how much relaxed rows give way beyond the least amount, as a share of the bounds' width."""

@torch.no_grad()
def lexicographic_anchor(
    sets: Sequence[ConstraintSet], candidate: Tensor | None = None, leeway: float = LEEWAY
) -> Anchored:
    """Find which sets hold in each state, by how much others give way, and the anchor.

    Cheap attempts first (`attempt_anchor`); the certified search takes the states that they leave
    undecided. A function of the states alone: of batches it does not depend what is found.

    A convex set is relaxed only on a certified upper bound of its slack, by an amount within 2 % of
    its depth of the least one, plus the leeway. Of non-convex sets convex parts are tried: those of
    the most room, those near points that all convex sets have in common, and those near a point of
    what is kept so far.

    Args:
        sets: K + 1 sets in order of application; ``sets[0]`` is the finite box of action bounds,
            which always holds, and the last has the highest priority.
        candidate: points that may lie in all sets, such as a known safe action, ``(*batch, d)``.
        leeway: by how much relaxed rows give way beyond the least amount, as a share of the bounds'
            smallest width; positive.

    Raises:
        ValueError: when the leeway is not positive.
        GeometryError: when ``sets[0]`` is no box; where a search is needed, also when it is
            unbounded or a field has NaN in it.
    """
    if not leeway > 0:
        raise ValueError(f"leeway: expected a number > 0, given {leeway}")
    bounds = bounds_of(sets)
    anchor, decided = attempt_anchor(sets, candidate)
    depths = row_depths(sets)
    shape = decided.shape
    relaxation = [torch.zeros_like(each).expand(*shape, each.shape[-1]) for each in depths]
    active = decided.unsqueeze(-1).expand(*shape, len(sets))
    if bool(decided.all()):
        return Anchored(anchor, active.clone(), tuple(relaxation))
    index = (~decided).flatten().nonzero().squeeze(-1)
    dim = anchor.shape[-1]
    search = Search.of(
        [each.select(shape, index) for each in sets],
        torch.cat([_flat(each, shape)[index] for each in depths], -1),
        leeway * _flat(smallest_width(bounds).unsqueeze(-1), shape)[index].squeeze(-1),
    )
    found = search.run()
    amounts = [
        _flat(each, shape).index_copy(0, index, rows.to(each)).view(*shape, -1)
        for each, rows in zip(relaxation, found.relaxation, strict=True)
    ]
    return Anchored(
        anchor.reshape(-1, dim).index_copy(0, index, found.anchor.to(anchor)).view(*shape, dim),
        active.reshape(-1, len(sets)).index_copy(0, index, found.active).view(*shape, -1),
        tuple(amounts),
    )


def relaxation_floor(sets: Sequence[ConstraintSet], leeway: float = LEEWAY) -> Tensor:
    """Return the relaxation that a set has where it can just be touched, ``(*batch, K + 1)``.

    An equality stated as two half-spaces, a point, a bound of 0: sets without interior are relaxed
    by this much at most, and no action need leave them by more than that. A larger relaxation says
    that a constraint could not be had.

    Args:
        sets: as in `lexicographic_anchor`.
        leeway: the same.
    """
    more = leeway * smallest_width(bounds_of(sets))
    floors = [(1 + 2 * PRECISION) * each.amax(-1) + more for each in row_depths(sets)]
    return torch.stack(torch.broadcast_tensors(*floors), -1)


def chebyshev_center(sets: Sequence[ConstraintSet], share: float = 0.5) -> Best:
    """Find points whose smallest slack in all sets is a large share of the best one.

    A batched interior-point method in float64. A set that does not describe its `superlevel` is cut
    out by linearizations of its slack, which takes longer. Of a non-convex set a convex part counts.

    Args:
        sets: sets of batch shape ``(B,)``, the first a finite box.
        share: the share of the best slack that will do, below 1; where that is negative, of the
            bounds' width how close to it the slack comes is the rest.

    Returns:
        Actions ``(B, d)``, their slacks ``(B,)`` and upper bounds of the best slacks ``(B,)``.

    Raises:
        GeometryError: when the first set is no finite box, or a field has NaN in it.
    """
    everything = Intersection.of(sets)
    middle = (everything.bounds.low + everything.bounds.high) / 2
    rows = torch.ones_like(everything.row_slacks(middle), dtype=torch.bool)
    width = smallest_width(everything.bounds)

    def settled(lower: Tensor, upper: Tensor, index: Tensor) -> Tensor:
        size = torch.where(lower > 0, upper, width[index])
        return (upper - lower <= (1 - share) * size) | (upper - lower <= 1e-9 * width[index])

    return everything.maximize(torch.zeros_like(rows, dtype=middle.dtype), rows, rows, middle, settled)


def _flat(rows: Tensor, shape: torch.Size) -> Tensor:
    """Return values ``(*batch, m)`` of all batch elements, ``(B, m)``."""
    return rows.expand(*shape, rows.shape[-1]).reshape(-1, rows.shape[-1])
