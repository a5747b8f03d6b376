"""Intersections of sets as the search sees them: slacks row by row, and points of most room."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from cnfp_torchrl.geometry.anchor.cutting_planes import maximize_slack_by_cuts
from cnfp_torchrl.geometry.anchor.interior_point import Best, Settled, maximize_slack
from cnfp_torchrl.geometry.anchor.program import Program
from cnfp_torchrl.geometry.box import Box
from cnfp_torchrl.geometry.constraint_set import ConstraintSet, GeometryError
from cnfp_torchrl.geometry.superlevel import Cone, KinkedSum, Rows, Superlevel


@dataclass(frozen=True, eq=False)
class Intersection:
    """B intersections of sets, whose R rows stand side by side, in the order of the sets.

    Args:
        sets: in float64, of batch shape ``(B,)``; the first is the finite box of action bounds.
        widths: the number of rows of each set, R in sum.
        program: the inequalities that describe the sets, or of non-convex ones a convex part.
        described: the row of each of the program's inequalities, ``(M,)``.
        plain: the sets that only state their slack.
    """

    sets: Sequence[ConstraintSet]
    widths: tuple[int, ...]
    program: Program
    described: Tensor
    plain: tuple[int, ...]

    @classmethod
    def of(cls, sets: Sequence[ConstraintSet], near: Tensor | None = None) -> Self:
        """Describe sets of batch shape ``(B,)`` in any dtype.

        Args:
            sets: the first is the finite box of action bounds.
            near: of non-convex sets the parts near these points count, ``(B, d)``; None means those
                that `ConstraintSet.superlevel` describes.

        Raises:
            GeometryError: when the first set is no finite box, or a field has NaN in it.
        """
        wide = [s.to(torch.float64) for s in sets]
        bounds = wide[0]
        if not isinstance(bounds, Box) or not bool((bounds.high - bounds.low).isfinite().all()):
            raise GeometryError("sets[0]: expected a finite Box of action bounds")
        for i, constraint_set in enumerate(wide):
            for name, field in constraint_set.fields().items():
                if bool(field.isnan().any()):
                    raise GeometryError(f"sets[{i}], field '{name}': expected numbers, given NaN")
        middle = (bounds.low + bounds.high) / 2
        widths = tuple(int(s.row_slacks(middle).shape[-1]) for s in wide)
        program, described, plain = _described(wide, widths, near)
        return cls(wide, widths, program, described, plain)

    def near(self, point: Tensor) -> Self:
        """Return the intersections with the convex parts near points ``(B, d)`` in their place."""
        if all(self.convex):
            return self
        program, described, plain = _described(self.sets, self.widths, point)
        return type(self)(self.sets, self.widths, program, described, plain)

    @property
    def convex(self) -> list[bool]:
        """Which of the sets are convex."""
        return [type(s).part_near is ConstraintSet.part_near for s in self.sets]

    @property
    def bounds(self) -> Box:
        """The action bounds."""
        bounds = self.sets[0]
        assert isinstance(bounds, Box)
        return bounds

    def rows_of(self, index: int) -> slice:
        """Return where the rows of a set stand."""
        first = sum(self.widths[:index])
        return slice(first, first + self.widths[index])

    def row_slacks(self, action: Tensor) -> Tensor:
        """Return the slacks of all rows, ``(B, R)``."""
        slacks = [
            constraint_set.row_slacks(action).expand(len(action), width)
            for constraint_set, width in zip(self.sets, self.widths, strict=True)
        ]
        return torch.cat(slacks, -1)

    def select(self, index: Tensor) -> Self:
        """Return some of the B intersections."""
        shape = torch.Size([len(self.program.rows)])
        sets = [s.select(shape, index) for s in self.sets]
        return type(self)(sets, self.widths, self.program.select(index), self.described, self.plain)

    def maximize(
        self, required: Tensor, trial: Tensor, counts: Tensor, start: Tensor, settled: Settled
    ) -> Best:
        """Find the largest t by which the slacks of rows on trial exceed what is required of them.

        Args:
            required: slacks of all rows, ``(B, R)``.
            trial: which rows are on trial, boolean ``(B, R)``; all others must have what is
                required, and do at the start.
            counts: which rows count at all, boolean ``(B, R)``.
            start: points strictly inside of what the rows not on trial require, ``(B, d)``.
            settled: tells which problems need no more work.
        """
        at = self.described
        problem = self.program.requiring(required[:, at], trial[:, at], counts[:, at])
        if not self.plain:
            return maximize_slack(problem, start, settled)
        sets = [self.sets[i] for i in self.plain]
        rows = [self.rows_of(i).start for i in self.plain]
        return maximize_slack_by_cuts(
            problem,
            sets,
            required[:, rows],
            trial[:, rows],
            counts[:, rows],
            start,
            settled,
        )


def _described(
    sets: Sequence[ConstraintSet], widths: Sequence[int], near: Tensor | None
) -> tuple[Program, Tensor, tuple[int, ...]]:
    """Return the program, the row of each of its inequalities, and the sets left out of it."""
    parts = [s.superlevel() if near is None else s.part_near(near) for s in sets]
    known = [part for part in parts if part is not None]
    owners: dict[type[Superlevel], list[int]] = {KinkedSum: [], Rows: [], Cone: []}
    first = 0
    for part, width in zip(parts, widths, strict=True):
        if part is not None:
            count = part.offsets.shape[-1] if isinstance(part, Rows) else 1
            # One inequality for each row, or several that make up a single one.
            owners[type(part)] += [first + (i if count == width else 0) for i in range(count)]
        first += width
    described = torch.tensor(owners[KinkedSum] + owners[Rows] + owners[Cone])
    plain = tuple(i for i, part in enumerate(parts) if part is None)
    device = next(iter(sets[0].fields().values())).device
    bounds = sets[0]
    assert isinstance(bounds, Box)
    return Program.stack(known, bounds), described.to(device), plain
