"""Intersections of sets as the search sees them: slacks row by row, and points of most room."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch

from cnfp_torchrl.geometry.anchor.closed_form import maximize_slack_over_box
from cnfp_torchrl.geometry.anchor.cutting_planes import maximize_slack_by_cuts
from cnfp_torchrl.geometry.anchor.interior_point import Best, Settled, maximize_slack
from cnfp_torchrl.geometry.anchor.program import Array, Flags, Index, Program
from cnfp_torchrl.geometry.box import Box
from cnfp_torchrl.geometry.constraint_set import ConstraintSet, GeometryError
from cnfp_torchrl.geometry.superlevel import Cone, KinkedSum, Rows, Superlevel


@dataclass(frozen=True, eq=False)
class Intersection:
    """B intersections of sets, whose R rows stand side by side, in the order of the sets.

    Args:
        sets: The sets in float64 on the CPU, of batch shape ``(B,)``; the first is the finite box
            of action bounds.
        widths: The number of rows of each set, R in sum.
        program: The inequalities that describe the sets, or of non-convex ones a convex part.
        described: The row of each of the program's inequalities, ``(M,)``.
        own: The sets that tell their slacks themselves, because no description of them does.
        plain: Those of them that have no description.
    """

    sets: Sequence[ConstraintSet]
    widths: tuple[int, ...]
    program: Program
    described: Index
    own: tuple[int, ...]
    plain: tuple[int, ...]

    @classmethod
    def of(cls, sets: Sequence[ConstraintSet]) -> Self:
        """Describe sets of batch shape ``(B,)`` in any dtype, on any device.

        Args:
            sets: The first is the finite box of action bounds.

        Raises:
            GeometryError: when the first set is no finite box, or a field has NaN in it.
        """
        wide = [s.to(torch.float64, "cpu") for s in sets]
        bounds = wide[0]
        if not isinstance(bounds, Box) or not bool((bounds.high - bounds.low).isfinite().all()):
            raise GeometryError("sets[0]: expected a finite Box of action bounds")
        for i, constraint_set in enumerate(wide):
            for name, field in constraint_set.fields().items():
                if np.isnan(field.detach().numpy().min(initial=np.inf)):
                    raise GeometryError(f"sets[{i}], field '{name}': expected numbers, given NaN")
        return cls._described(wide, tuple(s.row_count() for s in wide), None)

    def near(self, point: Array) -> Self:
        """Return the intersections with the convex parts near points ``(B, d)`` in their place."""
        return self if all(self.convex) else self._described(self.sets, self.widths, point)

    @classmethod
    def _described(
        cls, sets: Sequence[ConstraintSet], widths: tuple[int, ...], near: Array | None
    ) -> Self:
        if near is None:
            parts = [s.superlevel() for s in sets]
        else:
            parts = [s.part_near(torch.from_numpy(near)) for s in sets]
        owners: dict[type[Superlevel], list[int]] = {KinkedSum: [], Rows: [], Cone: []}
        own, first = [], 0
        for i, (part, width) in enumerate(zip(parts, widths, strict=True)):
            count = part.offsets.shape[-1] if isinstance(part, Rows) else 1
            if part is not None:
                # One inequality for each row, or several that make up a single one.
                owners[type(part)] += [first + (j if count == width else 0) for j in range(count)]
            if part is None or count != width or not sets[i].is_convex():
                own.append(i)
            first += width
        described = np.array(owners[KinkedSum] + owners[Rows] + owners[Cone])
        plain = tuple(i for i, part in enumerate(parts) if part is None)
        bounds = sets[0]
        assert isinstance(bounds, Box)
        program = Program.stack([part for part in parts if part is not None], bounds)
        return cls(sets, widths, program, described, tuple(own), plain)

    @property
    def convex(self) -> list[bool]:
        """Which of the sets are convex."""
        return [s.is_convex() for s in self.sets]

    @property
    def bounds(self) -> tuple[Array, Array]:
        """The action bounds, low and high, ``(B, d)``."""
        middle, half = self.program.middle.T, self.program.half.T
        return middle - half, middle + half

    def middle_of_boxes(self, least: Array) -> Array:
        """Return the middles of the boxes around the sets, ``(B, d)``.

        From the highest priority down those boxes count that leave half widths of ``(B,)``.
        """
        low, high = self.bounds
        for constraint_set in reversed(self.sets[1:]):
            lower, upper = (bound.numpy() for bound in constraint_set.bounding_box())
            lower, upper = np.maximum(low, lower), np.minimum(high, upper)
            wide = ((upper - lower).min(-1) > 2 * least)[:, None]
            low, high = np.where(wide, lower, low), np.where(wide, upper, high)
        return (low + high) / 2

    def rows_of(self, index: int) -> slice:
        """Return where the rows of a set stand."""
        first = sum(self.widths[:index])
        return slice(first, first + self.widths[index])

    def row_slacks(self, action: Array) -> Array:
        """Return the slacks of all rows, ``(B, R)``."""
        slacks = np.empty((len(action), sum(self.widths)))
        rooms = self.program.rooms(self.program.at(action)) * self.program.unit
        slacks[:, self.described] = rooms.T
        for i in self.own:
            slacks[:, self.rows_of(i)] = self.sets[i].row_slacks(torch.from_numpy(action)).numpy()
        return slacks

    def select(self, index: Index) -> Self:
        """Return some of the B intersections, by indices in ascending order."""
        if len(index) == len(self.program.unit):
            return self
        shape, at = torch.Size([len(self.program.unit)]), torch.from_numpy(index)
        # Of sets that a description tells all about nothing reads the fields any more.
        read = range(len(self.sets)) if not all(self.convex) else self.own
        sets = [s.select(shape, at) if i in read else s for i, s in enumerate(self.sets)]
        program = self.program.select(index)
        return type(self)(sets, self.widths, program, self.described, self.own, self.plain)

    def maximize(
        self, required: Array, maximized: Flags, counts: Flags, start: Array, settled: Settled
    ) -> Best:
        """Find the largest t by which the slacks of maximized rows exceed what is required of them.

        Args:
            required: Slacks of all rows, ``(B, R)``.
            maximized: The mask of these rows, ``(B, R)``; all others must have what is required,
                and do at the start.
            counts: Which rows count at all, ``(B, R)``.
            start: Points strictly inside of what the other rows require, ``(B, d)``.
            settled: The function that tells which problems need no more work.
        """
        at = self.described
        problem = self.program.requiring(required[:, at].T, maximized[:, at].T, counts[:, at].T)
        if not self.plain:
            over_box = not maximized[:, self.rows_of(0)].any()
            solve = maximize_slack_over_box if over_box else maximize_slack
            return solve(problem, start, settled)
        sets = [self.sets[i] for i in self.plain]
        rows = [self.rows_of(i).start for i in self.plain]
        return maximize_slack_by_cuts(
            problem, sets, required[:, rows], maximized[:, rows], counts[:, rows], start, settled
        )
