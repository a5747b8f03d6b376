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
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from cnfp_torchrl.geometry.anchor.attempts import (
    Attempt,
    first_attempt,
    refined_attempt,
    stepped_attempt,
    steps_may_help,
)
from cnfp_torchrl.geometry.anchor.depth import bounds_of, row_depths
from cnfp_torchrl.geometry.anchor.intersection import Intersection
from cnfp_torchrl.geometry.anchor.program import Array, Flags, Index
from cnfp_torchrl.geometry.anchor.search import PRECISION, Anchored, Search
from cnfp_torchrl.geometry.constraint_set import ConstraintSet

LEEWAY = 1e-3
"""The amount by which rows are relaxed beyond the least one, as a share of the bounds' width.

A region only as wide as the depth would leave a policy no room. In relaxed states of 2 and 6
dimensions, from 1e-5 to 1e-2, the gradient of the log-density in the latent stays the same (medians
1.7 and 4.4: it depends on directions alone), but each factor of ten makes the action's gradient ten
times larger and the log-density, which the entropy weight must make up for, d log(10) smaller. At
1e-3 a relaxed state's actions lie within about a thousandth of the bounds' width of the best ones,
the log-density is some 8 d above that of the bounds, and float32's rounding is a thousandth of what
is left.
"""


class Begun(NamedTuple):
    """The rule after its cheapest attempts, which decide many states.

    Attributes:
        sets: Sets in order of application.
        attempt: Points, and whether they are anchors.
    """

    sets: Sequence[ConstraintSet]
    attempt: Attempt

    def all_held(self) -> Anchored:
        """Return the anchors of states that are all decided: all sets hold."""
        shape, anchor = self.attempt.decided.shape, self.attempt.anchor
        active = torch.ones(*shape, len(self.sets), dtype=torch.bool, device=anchor.device)
        amounts = tuple(anchor.new_zeros(*shape, s.row_count()) for s in self.sets)
        return Anchored(anchor, active, amounts)

    def steps_may_help(self) -> bool:
        """Tell whether `continue_anchor` may decide states that are undecided."""
        return steps_may_help(self.sets)


@torch.no_grad()
def begin_anchor(sets: Sequence[ConstraintSet], candidate: Tensor | None = None) -> Begun:
    """Make the attempts that take the least time, and read no tensor on the host.

    Args:
        sets: Sets in order of application, as in `lexicographic_anchor`.
        candidate: Points that may lie in all sets, ``(*batch, d)``.
    """
    return Begun(sets, first_attempt(sets, candidate))


@torch.no_grad()
def continue_anchor(begun: Begun) -> Begun:
    """Take the steps inwards of `finish_anchor` in all states that they may decide, side by side.

    For compiled code, in which a step costs little: reads no tensor on the host.

    Args:
        begun: What `begin_anchor` returned.
    """
    return begun._replace(attempt=stepped_attempt(begun.sets, begun.attempt))


def lexicographic_anchor(
    sets: Sequence[ConstraintSet], candidate: Tensor | None = None, leeway: float = LEEWAY
) -> Anchored:
    """Find which sets hold in each state, by how much the others are relaxed, and the anchor.

    Cheap attempts come first (`attempt_anchor`); the certified search takes the states that they
    leave undecided. What is found in a state does not depend on the batch that it is in, but for
    rounding, which steps inwards pass on some thousandfold: of 14,700 random states in batches of
    700 and of 11, anchors in float32 differed by up to 4e-3, and what held or gave way in none.

    A convex set is relaxed only on a certified upper bound of its slack, by an amount within 2 % of
    its depth of the least one, plus the leeway. Of non-convex sets convex parts are tried: those of
    the most room, those near points that all convex sets have in common, and those near a point of
    what is kept so far.

    Args:
        sets: K + 1 sets in order of application; ``sets[0]`` is the finite box of action bounds,
            which always holds, and the last has the highest priority.
        candidate: Points that may lie in all sets, such as a known safe action, ``(*batch, d)``.
        leeway: The amount by which rows are relaxed beyond the least one, as a share of the bounds'
            smallest width; positive.

    Raises:
        ValueError: when the leeway is not positive.
        GeometryError: when ``sets[0]`` is no box; where a search is needed, also when it is
            unbounded or a field has NaN in it.
    """
    return finish_anchor(begin_anchor(sets, candidate), leeway)


@torch.no_grad()
def finish_anchor(begun: Begun, leeway: float = LEEWAY) -> Anchored:
    """Take steps inwards and search in the states that are not decided yet.

    Args:
        begun: What `begin_anchor` returned.
        leeway: Leeway, as in `lexicographic_anchor`.
    """
    if not leeway > 0:
        raise ValueError(f"leeway: expected a number > 0, given {leeway}")
    sets, found = begun
    shape = found.decided.shape
    _, active, relaxation = begun.all_held()
    found = found.select()
    anchor = found.anchor
    left = (~found.decided).nonzero().squeeze(-1)
    if len(left):
        # Steps inwards for the states that need them, and the search for those that need more.
        # Where these are most states, choosing them takes longer than steps in the others.
        some, part = sets, shape
        if 2 * len(left) < len(anchor):
            # Not action bounds that are the same for all, of which more is known.
            some = [s.select(shape, left) if s.batch_shape else s for s in sets]
            part, found = left.shape, found.select(left)
        depths = [depth.expand(*part, depth.shape[-1]) for depth in row_depths(some)]
        depth = torch.cat(depths, -1)
        refined = refined_attempt(some, found.view(part), depth.amax(-1))
        depth = depth.reshape(-1, depth.shape[-1])
        if part is shape:
            refined, depth = refined.select(left), depth[left]
        anchor = anchor.index_copy(0, left, refined.anchor)
        hard = (~refined.decided).nonzero().squeeze(-1)
        found, left = refined.select(hard), left[hard]
    if len(left):
        sets, depth = [s.select(shape, left) for s in sets], depth[hard]
        margin = leeway * bounds_of(sets).smallest_width()
        searched = Search.of(sets, depth, margin).run(found.anchor, found.upper)
        anchor = anchor.index_copy(0, left, searched.anchor.to(anchor))
        active.view(-1, len(sets)).index_copy_(0, left, searched.active.to(active.device))
        # Rounded up, by as much as the sum of a large amount and a field may be rounded down.
        up = 1 + 4 * torch.finfo(anchor.dtype).eps
        for amount, found_amount in zip(relaxation, searched.relaxation, strict=True):
            flat = amount.view(-1, amount.shape[-1])
            flat.index_copy_(0, left, (up * found_amount).to(amount))
    return Anchored(anchor.view(*shape, anchor.shape[-1]), active, relaxation)


def relaxation_floor(sets: Sequence[ConstraintSet], leeway: float = LEEWAY) -> Tensor:
    """Return the relaxation that a set has where it can just be touched, ``(*batch, K + 1)``.

    Sets without interior, such as a point or an equality stated as two half-spaces, are relaxed by
    this much at most. A larger relaxation means that a constraint could not hold.

    Args:
        sets: Sets in order of application, as in `lexicographic_anchor`.
        leeway: Leeway, as in `lexicographic_anchor`.
    """
    more = leeway * bounds_of(sets).smallest_width()
    floors = [(1 + 2 * PRECISION) * depth.amax(-1) + more for depth in row_depths(sets)]
    return torch.stack(torch.broadcast_tensors(*floors), -1)


class ChebyshevCenter(NamedTuple):
    """The best found actions ``(B, d)``, their slacks, and upper bounds of the slack ``(B,)``."""

    action: Tensor
    slack: Tensor
    upper_bound: Tensor


def chebyshev_center(sets: Sequence[ConstraintSet], share: float = 0.5) -> ChebyshevCenter:
    """Find points whose smallest slack in all sets is a large share of the best one.

    A batched interior-point method in float64. A set that does not describe its `superlevel` is
    cut out by linearizations of its slack, which takes longer. Of a non-convex set a convex part
    counts.

    Args:
        sets: Sets of batch shape ``(B,)``, the first a finite box.
        share: The share of the best slack that is enough, below 1; where the best slack is
            negative, the one found is lower by at most ``1 - share`` of it.

    Returns:
        Actions ``(B, d)``, their slacks ``(B,)`` and upper bounds of the best slacks ``(B,)``.

    Raises:
        GeometryError: when the first set is no finite box, or a field has NaN in it.
    """
    everything = Intersection.of(sets)
    low, high = everything.bounds
    middle, width = (low + high) / 2, (high - low).min(-1)
    rows = np.ones((len(low), sum(everything.widths)), dtype=bool)

    def settled(lower: Array, upper: Array, index: Index) -> Flags:
        gap, decided = upper - lower, (lower > 0) | (upper < 0)
        close = gap <= (1 - share) * np.maximum(upper, -lower)
        return (decided & close) | (gap <= 1e-9 * width[index])

    best = everything.maximize(np.zeros(rows.shape), rows, rows, middle, settled)
    like = next(iter(sets[0].fields().values()))
    return ChebyshevCenter(*(torch.from_numpy(value).to(like.device) for value in best[:3]))
