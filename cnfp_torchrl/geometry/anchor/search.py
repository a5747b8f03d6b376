"""The certified search: the lexicographic rule by an interior-point method, for the states left."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from typing import NamedTuple

import torch
from torch import Tensor

from cnfp_torchrl.geometry.anchor.attempts import (
    Attempt,
    further_attempt,
    refined_attempt,
)
from cnfp_torchrl.geometry.anchor.interior_point import Best
from cnfp_torchrl.geometry.anchor.intersection import Intersection
from cnfp_torchrl.geometry.constraint_set import ConstraintSet

SHARE = 0.6
"""The share of the best slack that a searched anchor has."""

PRECISION = 0.02
"""The largest distance of an amount from the least one, as a share of the depth."""

_FAR = 10.0
"""The depth, in diagonals of the bounds, from which on a row cannot tell actions apart."""


class Anchored(NamedTuple):
    """The anchors of some states, which sets hold there, and by how much others are relaxed.

    A set holds (active, relaxation 0), is relaxed (not active, relaxation finite) or dropped (not
    active, infinite: only families that cannot be inflated, `ConstraintSet.can_be_inflated`).

    Attributes:
        anchor: points well inside the region, ``(*batch, d)``.
        active: flags of the sets that hold as stated, boolean ``(*batch, K + 1)``.
        relaxation: amounts by which the m rows of each set are widened, ``(*batch, m)`` for each.
    """

    anchor: Tensor
    active: Tensor
    relaxation: tuple[Tensor, ...]

    def largest(self) -> Tensor:
        """Return the relaxation of each set, its largest row's, ``(*batch, K + 1)``."""
        return torch.stack([amount.amax(-1) for amount in self.relaxation], -1)


class Search:
    """The lexicographic rule for B states, by the certified method.

    It keeps for each of the R rows of all sets its depth, its relaxation so far, and whether it
    counts yet, and for each state a point strictly inside of the rows that count.

    Args:
        everything: sets of the states.
        depth: depths of all rows, ``(B, R)``.
        leeway: amounts of relaxation beyond the least ones, ``(B,)``.
    """

    def __init__(self, everything: Intersection, depth: Tensor, leeway: Tensor) -> None:
        bounds = everything.bounds
        self.everything, self.depth, self.leeway = everything, depth, leeway
        self.kept = (bounds.low + bounds.high) / 2
        self.relaxation = torch.zeros_like(depth)
        diagonal = torch.linalg.vector_norm(bounds.high - bounds.low, dim=-1, keepdim=True)
        self.far = depth >= _FAR * diagonal
        self.far[:, everything.rows_of(0)] = False
        self.counts = torch.zeros_like(self.far)
        self.counts[:, everything.rows_of(0)] = True
        self.dropped = torch.zeros(len(depth), len(everything.sets), dtype=torch.bool)
        self.dropped = self.dropped.to(depth.device)

    @classmethod
    def of(cls, sets: Sequence[ConstraintSet], depth: Tensor, leeway: Tensor) -> Search:
        return cls(Intersection.of(sets), depth.double(), leeway.double())

    def run(self, upper: Tensor) -> Anchored:
        """Apply the rule.

        Args:
            upper: upper bounds of the best slack in all sets, if they are convex, ``(B,)``.
        """
        fits = torch.zeros_like(self.far[:, 0])
        # Where even a slack of less than 0 is out of reach, there is no need to look for more.
        open_ = upper > -self.depth.amin(-1) if all(self.everything.convex) else ~fits
        left = open_.nonzero().squeeze(-1)
        if len(left):
            some = Search(self.everything.select(left), self.depth[left], self.leeway[left])
            fits[left] = some._fit(~some.far)
            self.kept[left] = some.kept
        # Far rows hold or give way wherever the anchor is.
        rooms = self.everything.row_slacks(self.kept) - self.depth
        fits = fits & ((rooms >= 0) | ~self.far).all(-1)
        left = (~fits).nonzero().squeeze(-1)
        if len(left):
            rest = Search(self.everything.select(left), self.depth[left], self.leeway[left])
            rest._relax()
            self.kept[left], self.relaxation[left] = rest.kept, rest.relaxation
            self.dropped[left] = rest.dropped
        amounts = self.relaxation.split(self.everything.widths, -1)
        amounts = tuple(
            amount.masked_fill(gone.unsqueeze(-1), torch.inf)
            for amount, gone in zip(amounts, self.dropped.unbind(-1), strict=True)
        )
        active = torch.stack([(amount == 0).all(-1) for amount in amounts], -1)
        return Anchored(self.kept, active, amounts)

    def _relax(self) -> None:
        """Decide one set after the other, and then the anchor."""
        convex = self.everything.convex
        for k in range(len(convex) - 1, 0, -1):
            rows = torch.zeros_like(self.far)
            rows[:, self.everything.rows_of(k)] = True
            far = rows & self.far
            short = self.depth - self.everything.row_slacks(self.kept) + self.leeway.unsqueeze(-1)
            self.relaxation = torch.where(far & (short > 0), short, self.relaxation)
            rows = rows & ~far
            left = rows.any(-1)
            if not all(convex[k:]):
                left = left & ~self._fit(self.counts | rows)
            if convex[k] and type(self.everything.sets[k]).can_be_inflated():
                self._give_way(k, rows & left.unsqueeze(-1))
            else:
                if convex[k]:
                    left = left & ~self._fit(self.counts | rows)
                self.dropped[:, k] = left
                rows = rows & ~left.unsqueeze(-1)
            self.counts = self.counts | rows
            if k > 1:
                self._step_inwards(k)
        self._anchor()

    def _anchor(self) -> None:
        """Move well inside of what is left, by steps inwards where they suffice."""
        if self._has_odd_sets():
            self._fit(self.counts)
            return
        found = refined_attempt(*self._widened(1))
        self._move_to(found)
        left = (~found.decided).nonzero().squeeze(-1)
        if len(left):
            some = Search(self.everything.select(left), self.depth[left], self.leeway[left])
            some.relaxation, some.kept = self.relaxation[left], self.kept[left]
            some._fit(self.counts[left])
            self.kept[left] = some.kept

    def _step_inwards(self, k: int) -> None:
        """Move away from the boundaries of set k and those before it, for a better start."""
        if not self._has_odd_sets():
            self._move_to(further_attempt(*self._widened(k), steps=3))

    def _move_to(self, found: Attempt) -> None:
        """Move to where an attempt led, unless that is outside of the bounds or nearly so.

        Beside sets 1e15 times further away than the bounds are wide an attempt knows no better:
        rounding errors of their slacks are as large as the bounds.
        """
        bounds, depth = self.everything.bounds, self.depth[:, self.everything.rows_of(0)]
        inside = found.decided | (bounds.row_slacks(found.anchor) >= depth).all(-1)
        self.kept = torch.where(inside.unsqueeze(-1), found.anchor, self.kept)

    def _has_odd_sets(self) -> bool:
        """Tell whether steps inwards do not see all that counts."""
        return not all(self.everything.convex) or bool(self.far.any() | self.dropped.any())

    def _widened(self, k: int) -> tuple[list[ConstraintSet], list[Tensor], Attempt]:
        """Return bounds and sets from k on as relaxed so far, their depths, and the kept points."""
        amounts = self.relaxation.split(self.everything.widths, -1)
        depths = self.depth.split(self.everything.widths, -1)
        sets = [self.everything.sets[0]] + [
            s.inflated(amount) if s.can_be_inflated() else s
            for s, amount in zip(self.everything.sets[k:], amounts[k:], strict=True)
        ]
        bounds = self.everything.bounds
        upper = (bounds.high - bounds.low).amin(-1) / 2
        # A row that gives way is left with no more room than the depth that it kept and the leeway.
        room = (1 + PRECISION) * self.depth + self.leeway.unsqueeze(-1)
        room = torch.where(self.relaxation > 0, room, torch.inf).amin(-1)
        undecided = torch.zeros_like(self.far[:, 0])
        start = Attempt(self.kept, torch.minimum(upper, room), undecided)
        return sets, [depths[0], *depths[k:]], start

    def _give_way(self, k: int, trial: Tensor) -> None:
        """Relax the rows on trial by lexicographic minimax."""
        precision = PRECISION * self.depth[:, self.everything.rows_of(k)].amin(-1)
        counts = self.counts.clone()
        trial = trial.clone()
        while True:
            required = self.depth - self.relaxation
            rooms = self.everything.row_slacks(self.kept) - required
            short = torch.where(trial, rooms, torch.inf).amin(-1) < precision
            left = short.nonzero().squeeze(-1)
            if not len(left):
                return
            some = self.everything.near(self.kept).select(left)
            wanted, tried, needs = precision[left], trial[left], required[left]

            def settled(lower: Tensor, upper: Tensor, index: Tensor) -> Tensor:
                near = wanted[index]  # noqa: B023 - called before it changes
                return (lower >= near) | (upper - lower <= near)

            best = some.maximize(needs, tried, counts[left] | tried, self.kept[left], settled)
            rooms = some.row_slacks(best.action) - needs
            least = torch.where(tried, rooms, torch.inf).amin(-1)
            gives = least <= wanted / 4
            binding = tried & (rooms <= (least + 5 * wanted).unsqueeze(-1)) & gives.unsqueeze(-1)
            amount = (self.leeway[left] - least).unsqueeze(-1)
            self.relaxation[left] = torch.where(binding, amount, self.relaxation[left])
            # Back towards where it came from, by what half of the leeway allows: Newton's method is
            # slow to leave the boundaries that the best point lies on.
            before = self.kept[left]
            short = least - torch.where(binding, some.row_slacks(before) - needs, torch.inf).amin(
                -1
            )
            share = (self.leeway[left] / (2 * self.leeway[left] + 2 * short.relu())).unsqueeze(-1)
            share = torch.where(gives.unsqueeze(-1), share, 0.0)
            self.kept[left] = best.action + share * (before - best.action)
            counts[left] = counts[left] | binding
            trial[left] = tried & ~binding & gives.unsqueeze(-1)

    def _fit(self, rows: Tensor) -> Tensor:
        """Move to points well inside of some rows where there are such, and tell where.

        Args:
            rows: flags of the rows, those of the bounds among them, boolean ``(B, R)``.
        """
        found = self._roomiest(self.everything, rows)
        fits = found.slack >= 0
        kept = self.kept
        self.kept = torch.where(fits.unsqueeze(-1), found.action, kept)
        if all(self.everything.convex) or bool(fits.all()):
            return fits
        of_convex = rows.clone()
        for k, convex in enumerate(self.everything.convex):
            of_convex[:, self.everything.rows_of(k)] &= convex
        relaxed = self._roomiest(self.everything, of_convex)
        possible = relaxed.upper_bound >= 0
        around = self._around(relaxed.action, of_convex)
        for near in chain((relaxed.action, kept), around):
            left = (possible & ~fits).nonzero().squeeze(-1)
            if not len(left):
                break
            part = self.everything.select(left).near(near[left])
            found = self._roomiest(part, rows, left)
            fits[left] = found.slack >= 0
            self.kept[left] = torch.where(fits[left].unsqueeze(-1), found.action, self.kept[left])
        return fits

    def _roomiest(self, part: Intersection, rows: Tensor, index: Tensor | None = None) -> Best:
        """Find points with most slack beyond what rows require, or that there are none.

        Args:
            part: sets of the states at the index.
            rows: flags of the rows that count, boolean ``(B, R)``.
            index: indices of the states; None means all.
        """
        index = torch.arange(len(rows), device=rows.device) if index is None else index
        chosen = rows[index]
        required = (self.depth - self.relaxation)[index]
        depth = torch.where(chosen, self.depth[index], torch.inf).amin(-1)

        def settled(lower: Tensor, upper: Tensor, at: Tensor) -> Tensor:
            h = depth[at]
            deep = (lower >= 0) & (lower + h >= SHARE * (upper + h))
            return (upper < 0) | deep | (upper - lower <= 1e-3 * h)

        return part.maximize(required, chosen, chosen, self.kept[index], settled)

    def _around(self, point: Tensor, rows: Tensor) -> Iterator[Tensor]:
        """Yield points ``(B, d)`` half of the way out of the sets of some rows, along each axis."""
        sets = self.everything.sets
        counts = torch.stack(
            [rows[:, self.everything.rows_of(k)].any(-1) for k in range(len(sets))], -1
        )
        for axis in torch.eye(point.shape[-1], dtype=point.dtype, device=point.device):
            for direction in (axis.expand_as(point), -axis.expand_as(point)):
                gauges = torch.stack([s.gauge(direction, point) for s in sets], -1)
                gauge = torch.where(counts, gauges, 0.0).amax(-1, keepdim=True)
                yield point + direction * (0.5 / gauge)
