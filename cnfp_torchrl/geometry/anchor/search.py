"""The certified search: the lexicographic rule by an interior-point method, for the states left."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from itertools import chain
from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from cnfp_torchrl.geometry.anchor.interior_point import Best
from cnfp_torchrl.geometry.anchor.intersection import Intersection
from cnfp_torchrl.geometry.anchor.program import Array, Flags, Index
from cnfp_torchrl.geometry.anchor.retreat import retreat
from cnfp_torchrl.geometry.constraint_set import ConstraintSet

SHARE = 0.35
"""The share of the best slack that a searched anchor has, no less than attempts have."""

PRECISION = 0.02
"""The largest distance of an amount from the least one, as a share of the depth."""

_FAR = 10.0
"""The depth, in diagonals of the bounds, from which on a row cannot tell actions apart."""


class Anchored(NamedTuple):
    """The anchors of some states, which sets hold there, and by how much others are relaxed.

    A set holds (active, relaxation 0), is relaxed (not active, relaxation finite) or dropped (not
    active, infinite: only families that cannot be inflated, `ConstraintSet.can_be_inflated`).

    Attributes:
        anchor: Points well inside the region, ``(*batch, d)``.
        active: Flags of the sets that hold as stated, boolean ``(*batch, K + 1)``.
        relaxation: Amounts by which the m rows of each set are widened, ``(*batch, m)`` for each.
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
    counts yet, and for each state a point strictly inside of the rows that count, with its slacks.

    Args:
        everything: Sets of the states.
        depth: Depths of all rows, ``(B, R)``.
        leeway: Amounts of relaxation beyond the least ones, ``(B,)``.
    """

    def __init__(self, everything: Intersection, depth: Array, leeway: Array) -> None:
        low, high = everything.bounds
        self.everything, self.depth, self.leeway = everything, depth, leeway
        self.kept = everything.middle_of_boxes(2 * depth[:, everything.rows_of(0)].max(-1))
        self.slacks = everything.row_slacks(self.kept)
        self.upper = np.full(len(depth), np.inf)
        self.relaxation = np.zeros_like(depth)
        self.far = depth >= _FAR * np.sqrt(np.square(high - low).sum(-1, keepdims=True))
        self.far[:, everything.rows_of(0)] = False
        self.counts = np.zeros_like(self.far)
        self.counts[:, everything.rows_of(0)] = True
        self.dropped = np.zeros((len(depth), len(everything.sets)), dtype=bool)

    # Compilers would trace NumPy's arithmetic as their own.
    @classmethod
    @torch.compiler.disable
    def of(cls, sets: Sequence[ConstraintSet], depth: Tensor, leeway: Tensor) -> Self:
        """Return the search for sets in any dtype, on any device."""
        numbers = (value.double().cpu().numpy() for value in (depth, leeway))
        return cls(Intersection.of(sets), *numbers)

    @torch.compiler.disable
    def run(self, start: Tensor, upper: Tensor) -> Anchored:
        """Apply the rule.

        Args:
            start: Points to start from, ``(B, d)``.
            upper: Upper bounds of the best slack in all sets, if they are convex, ``(B,)``.
        """
        # Sets may lie at infinity, as far as float64 knows.
        with np.errstate(all="ignore"):
            self._run(start.double().cpu().numpy(), upper.double().cpu().numpy())
        ends = np.cumsum(self.everything.widths)[:-1]
        amounts = np.split(self.relaxation, ends, -1)
        for amount, gone in zip(amounts, self.dropped.T, strict=True):
            amount[gone] = np.inf
        active = np.stack([(amount == 0).all(-1) for amount in amounts], -1)
        anchor, holds, *given = map(torch.from_numpy, (self.kept, active, *amounts))
        return Anchored(anchor, holds, tuple(given))

    def _run(self, start: Array, upper: Array) -> None:
        """Try all sets together, and give way where that fails."""
        fits = np.zeros(len(self.depth), dtype=bool)
        # Where even a slack of less than 0 is out of reach, there is no need to look for more.
        possible = upper > -self.depth.min(-1)
        left = (possible if all(self.everything.convex) else ~fits).nonzero()[0]
        if len(left):
            some = self._select(left)
            # From afar, as float64 sees it, nothing can be told of what is near.
            low, high = some.everything.bounds
            near = ((low <= start[left]) & (start[left] <= high)).all(-1, keepdims=True)
            some.kept = np.where(near, start[left], some.kept)
            fits[left] = some._fit(~some.far)
            self._take(some, left, fits[left])
        # Far rows hold or give way wherever the anchor is.
        if self.far.any():
            fits = fits & ((self.slacks >= self.depth) | ~self.far).all(-1)
        left = (~fits).nonzero()[0]
        if len(left):
            rest = self._select(left)
            rest._relax()
            self._take(rest, left)
            self.relaxation[left], self.dropped[left] = rest.relaxation, rest.dropped

    def _select(self, index: Index) -> Search:
        """Return the search for some states, from where it is now."""
        some = copy(self)
        for name, value in vars(self).items():
            if name != "everything":
                setattr(some, name, value[index])
        some.everything = self.everything.select(index)
        return some

    def _take(self, some: Search, index: Index, mask: Flags | slice = slice(None)) -> None:
        """Take over the points of some states, or of those in a mask."""
        self.kept[index[mask]], self.slacks[index[mask]] = some.kept[mask], some.slacks[mask]

    def _relax(self) -> None:
        """Decide one set after the other, and then the anchor."""
        convex = self.everything.convex
        for k in range(len(convex) - 1, 0, -1):
            rows = np.zeros_like(self.far)
            rows[:, self.everything.rows_of(k)] = True
            far = rows & self.far
            if far.any():
                short = self.depth - self.slacks + self.leeway[:, None]
                self.relaxation = np.where(far & (short > 0), short, self.relaxation)
            rows = rows & ~far
            left = rows.any(-1)
            if not all(convex[k:]):
                left = left & ~self._fit(self.counts | rows)
            if convex[k] and type(self.everything.sets[k]).can_be_inflated():
                self._give_way(k, rows & left[:, None])
            else:
                if convex[k]:
                    left = left & ~self._fit(self.counts | rows)
                self.dropped[:, k] = left
                rows = rows & ~left[:, None]
            self.counts = self.counts | rows
        left = (~self._is_deep(self.counts)).nonzero()[0]
        if len(left):
            some = self._select(left)
            some._fit(some.counts)
            self._take(some, left)

    def _give_way(self, k: int, maximized: Flags) -> None:
        """Relax the maximized rows by lexicographic minimax."""
        precision = PRECISION * self.depth[:, self.everything.rows_of(k)].min(-1)
        counts, maximized = self.counts.copy(), maximized.copy()
        while True:
            required = self.depth - self.relaxation
            rooms = self.slacks - required
            left = (np.where(maximized, rooms, np.inf).min(-1) < precision).nonzero()[0]
            if not len(left):
                return
            some = self.everything.near(self.kept).select(left)
            wanted, rising, needs = precision[left], maximized[left], required[left]

            def settled(lower: Array, upper: Array, index: Index) -> Flags:
                near = wanted[index]  # noqa: B023 - called before it changes
                return (lower >= near) | (upper - lower <= near)

            on = counts[left] | rising
            best = some.maximize(needs, rising, on, self.kept[left], settled)
            there = some.row_slacks(best.action)
            rooms = there - needs
            least = np.where(rising, rooms, np.inf).min(-1)
            gives = least <= wanted / 4
            binding = rising & (rooms <= (least + 5 * wanted)[:, None]) & gives[:, None]
            given = np.where(binding, (self.leeway[left] - least)[:, None], self.relaxation[left])
            maximized[left] = rising & ~binding & gives[:, None]
            counts[left] = counts[left] | binding
            # Newton's method is slow to leave the boundaries that the best point lies on.
            gain = given - self.relaxation[left]
            self.relaxation[left] = given
            sure = on & ~maximized[left]
            rooms, before = (slacks - needs + gain for slacks in (there, self.slacks[left]))
            share, upper = retreat(some, best, rooms, before, gain, on, sure)
            self.kept[left] = best.action + share * (self.kept[left] - best.action)
            self.slacks[left] = some.row_slacks(self.kept[left])
            self.upper[left] = np.where(gives, upper, self.upper[left])
            if k == 1 and all(self.everything.convex):
                self._hold_rest(left[gives])

    def _hold_rest(self, index: Index) -> None:
        """Move to points well inside of all rows, where what has given way so far is enough.

        Args:
            index: Indices of states in which rows of the lowest priority have just given way.
        """
        rows = self.counts.copy()
        rows[:, self.everything.rows_of(1)] = ~self.far[:, self.everything.rows_of(1)]
        left = index[~self._is_deep(rows)[index]]
        if not len(left):
            return
        some = self._select(left)
        found = some._roomiest(some.everything, rows[left])
        fits = found.slack >= 0
        left = left[fits]
        self.kept[left], self.upper[left] = found.action[fits], found.upper_bound[fits]
        self.slacks[left] = some.everything.row_slacks(found.action)[fits]

    def _is_deep(self, rows: Flags) -> Flags:
        """Tell where points have a large share of the best slack in some rows."""
        rooms = self.slacks - (self.depth - self.relaxation)
        least, depth = (np.where(rows, v, np.inf).min(-1) for v in (rooms, self.depth))
        return _is_deep(least, self.upper, depth)

    def _fit(self, rows: Flags) -> Flags:
        """Move to points well inside of some rows where there are such, and tell where.

        Args:
            rows: Flags of the rows, those of the bounds among them, ``(B, R)``.
        """
        found = self._roomiest(self.everything, rows)
        fits = found.slack >= 0
        kept = self.kept
        self.kept = np.where(fits[:, None], found.action, kept)
        if not (all(self.everything.convex) or fits.all()):
            self._fit_parts(rows, fits, kept)
        self.slacks = self.everything.row_slacks(self.kept)
        return np.asarray(fits)

    def _fit_parts(self, rows: Flags, fits: Flags, kept: Array) -> None:
        """Try other convex parts of non-convex sets, from points of the best so far and around.

        Args:
            rows: Flags of the rows, ``(B, R)``.
            fits: Flags of the states in which there is a point, which change, ``(B,)``.
            kept: Points strictly inside of the rows that count, ``(B, d)``.
        """
        of_convex = rows.copy()
        for k, convex in enumerate(self.everything.convex):
            of_convex[:, self.everything.rows_of(k)] &= convex
        relaxed = self._roomiest(self.everything, of_convex)
        possible = relaxed.upper_bound >= 0
        around = self._around(relaxed.action, of_convex)
        for near in chain((relaxed.action, kept), around):
            left = (possible & ~fits).nonzero()[0]
            if not len(left):
                break
            part = self.everything.select(left).near(near[left])
            found = self._roomiest(part, rows, left)
            fits[left] = found.slack >= 0
            self.kept[left] = np.where(fits[left][:, None], found.action, self.kept[left])

    def _roomiest(self, part: Intersection, rows: Flags, index: Index | None = None) -> Best:
        """Find points with most slack beyond what rows require, or that there are none.

        Args:
            part: Sets of the states at the index.
            rows: Flags of the rows that count, ``(B, R)``.
            index: Indices of the states; None means all.
        """
        index = np.arange(len(rows)) if index is None else index
        chosen = rows[index]
        required = (self.depth - self.relaxation)[index]
        depth = np.where(chosen, self.depth[index], np.inf).min(-1)

        def settled(lower: Array, upper: Array, at: Index) -> Flags:
            h = depth[at]
            return (upper < 0) | _is_deep(lower, upper, h) | (upper - lower <= 1e-3 * h)

        return part.maximize(required, chosen, chosen, self.kept[index], settled)

    def _around(self, point: Array, rows: Flags) -> Iterator[Array]:
        """Yield points ``(B, d)`` half of the way out of the sets of some rows, along each axis."""
        sets, start = self.everything.sets, torch.from_numpy(point)
        counts = np.stack(
            [rows[:, self.everything.rows_of(k)].any(-1) for k in range(len(sets))], -1
        )
        for axis in np.eye(point.shape[-1]):
            for direction in (axis, -axis):
                along = torch.from_numpy(direction).expand_as(start)
                gauges = np.stack([s.gauge(along, start).numpy() for s in sets], -1)
                gauge = np.where(counts, gauges, 0.0).max(-1, keepdims=True)
                yield point + direction * (0.5 / gauge)


def _is_deep(slack: Array, upper: Array, depth: Array) -> Flags:
    """Tell where slacks beyond the depth are a large share of the best one, by its bounds."""
    return np.asarray((slack >= 0) & (slack + depth >= SHARE * (upper + depth)))
