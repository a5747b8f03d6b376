r"""Problems of the largest smallest slack, as rows and second-order cones in one vector x.

A problem's unknowns are :math:`x = (a, t, u)`: the action in half widths of the bounds about their
middle, the slack t in mean half widths, and bounds u of the terms of kinked sums, of which each
makes two rows, :math:`\alpha_i a_i \le u_i` and :math:`\beta_i a_i \le u_i`.

The arrays are NumPy's, in float64, because a few small problems take a third of the time that way,
and the batch comes last in those of a program, because many of them are solved side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Self, TypeAlias

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from cnfp_torchrl.geometry.box import Box
from cnfp_torchrl.geometry.superlevel import Cone, KinkedSum, Rows, Superlevel

Array: TypeAlias = NDArray[np.float64]
Flags: TypeAlias = NDArray[np.bool_]
Index: TypeAlias = NDArray[np.int64]

START = 0.3
"""The distance of a first slack below the largest one at an action, in mean half widths."""


@dataclass(frozen=True, eq=False)
class Program:
    """B problems "maximize t such that all sets have slack t".

    All slacks grow at the rate of one: a row or cone with a 0 for t must hold whatever t is. One
    that does not count has no coefficients, and holds by 1 everywhere.

    Args:
        rows: Coefficients of ``rows @ x <= offsets``, ``(M, n, B)``: the terms of kinked sums, the
            sums, and other rows.
        offsets: Offsets of the rows, ``(M, B)``.
        loose: Offsets that let every action pass, for rows that do not count, ``(M, B)``.
        cones: Coefficients of ``tips - cones @ x``, whose first component is no less than the norm
            of the others, ``(J, 1 + k, n, B)``.
        tips: Constants of the cones, ``(J, 1 + k, B)``.
        middle: Middles of the bounds, ``(d, B)``.
        half: Half widths of the bounds, ``(d, B)``.
        unit: The mean half widths, ``(B,)``.
        reach: Largest values of the terms of sums, whose least ones are 0, ``(n - d - 1, B)``.
    """

    rows: Array
    offsets: Array
    loose: Array
    cones: Array
    tips: Array
    middle: Array
    half: Array
    unit: Array
    reach: Array

    @classmethod
    def stack(cls, parts: Sequence[Superlevel], bounds: Box) -> Self:
        """Stack descriptions, each with batch shape ``(B,)``: kinked sums, rows and cones.

        Args:
            parts: Descriptions in float64 on the CPU, one for each set.
            bounds: Finite bounds of the actions, ``(B, d)``.
        """
        rows = [part for part in parts if isinstance(part, Rows)]
        cones = [part for part in parts if isinstance(part, Cone)]
        sums = [part for part in parts if isinstance(part, KinkedSum)]
        batch, dim = bounds.low.shape
        low, high = batch_last(bounds.low, 1), batch_last(bounds.high, 1)
        middle, half = map(np.ascontiguousarray, ((low + high) / 2, (high - low) / 2))
        unit = half.sum(0) / dim
        terms = len(sums) * dim
        width = dim + 1 + terms
        reach = np.zeros((terms, batch))
        many = sum(part.offsets.shape[-1] for part in rows)
        first = 2 * terms + len(sums)
        stacked, offsets = np.zeros((first + many, width, batch)), np.zeros((first + many, batch))
        loose = np.ones_like(offsets)
        each = np.arange(dim)
        for i, total in enumerate(sums):
            own = i * dim + each
            rate = batch_last(total.rate, 0) * unit
            counts = rate > 0
            rate = np.where(counts, rate, 1.0)
            steepest = np.zeros((dim, batch))
            for j, slope in enumerate((total.upper, total.lower)):
                relative = batch_last(slope, 1) / rate
                stacked[j * terms + own, each] = relative * half
                stacked[j * terms + own, dim + 1 + own] = -1
                offsets[j * terms + own] = -relative * middle
                steepest = np.maximum(steepest, np.abs(relative))
            reach[own] = steepest * np.maximum(np.abs(low), np.abs(high))
            stacked[2 * terms + i, dim + 1 + own] = 1
            size = batch_last(total.size, 0) / rate
            offsets[2 * terms + i] = np.where(counts, size, np.inf)
            loose[2 * terms + i] = 3 + 2 * reach[own].sum(0)
        for part in rows:
            last = first + part.offsets.shape[-1]
            rates = batch_last(part.rates, 1)
            normals = batch_last(part.normals, 2) / rates[:, None]
            places = batch_last(part.offsets, 1) / rates
            offsets[first:last] = (places - times(normals, middle)) / unit
            stacked[first:last, :dim] = normals * (half / unit)
            first = last
        height = 1 + max((part.matrix.shape[-2] for part in cones), default=0)
        stacked_cones = np.zeros((len(cones), height, width, batch))
        tips = np.zeros((len(cones), height, batch))
        for i, cone in enumerate(cones):
            rate = batch_last(cone.rate, 0) * unit
            matrix = batch_last(cone.matrix, 2) / rate
            last = 1 + len(matrix)
            stacked_cones[i, 1:last, :dim] = -matrix * half
            tips[i, 1:last] = batch_last(cone.vector, 1) / rate + times(matrix, middle)
            tips[i, 0] = batch_last(cone.size, 0) / rate
        return cls(stacked, offsets, loose, stacked_cones, tips, middle, half, unit, reach)

    def requiring(self, required: Array, maximized: Flags, counts: Flags) -> Self:
        """Return the problems "maximize t such that all slacks exceed what is required by t".

        Args:
            required: Slacks ``(R, B)`` required of all sums, rows and cones, in this order.
            maximized: Flags of those that exceed it by t, ``(R, B)``; the others just have it.
            counts: Flags of those that count at all, ``(R, B)``.
        """
        first, dim, needs = len(self.reach) * 2, self.dim, required / self.unit
        split = len(self.rows) - first
        on, cone_on = counts[:split] & np.isfinite(self.offsets[first:]), counts[split:]
        rows, offsets = self.rows.copy(), self.offsets.copy()
        # Sums keep the terms, which nothing else bounds.
        sums = first // (2 * dim)
        rows[first + sums :] *= on[sums:, None]
        rows[first:, dim] = maximized[:split] & on
        offsets[first:] = np.where(on, offsets[first:] - needs[:split], self.loose[first:])
        cones, tips = self.cones * cone_on[:, None, None], self.tips * cone_on[:, None]
        cones[:, 0, dim] = maximized[split:] & cone_on
        tips[:, 0] = np.where(cone_on, tips[:, 0] - needs[split:], 1.0)
        return replace(self, rows=rows, offsets=offsets, cones=cones, tips=tips)

    @property
    def dim(self) -> int:
        """The dimension d of the actions."""
        return len(self.middle)

    def select(self, keep: Flags | Index) -> Self:
        """Return some of the B problems."""
        return type(self)(**{f.name: getattr(self, f.name)[..., keep] for f in fields(self)})

    def with_rows(self, normals: Array, offsets: Array, maximized: Flags, counts: Flags) -> Self:
        """Return the problems with rows added, where they count.

        Args:
            normals: Normals of the rows, ``(m, d, B)``, of slacks that are not divided further.
            offsets: Offsets of the rows, ``(m, B)``.
            maximized: Flags of the maximized rows, ``(m, B)``.
            counts: Flags of the rows that count, ``(m, B)``.
        """
        rows = np.zeros((len(normals), *self.rows.shape[1:]))
        rows[:, : self.dim] = normals * (self.half / self.unit) * counts[:, None]
        rows[:, self.dim] = maximized & counts
        offsets = np.where(counts, (offsets - times(normals, self.middle)) / self.unit, 1.0)
        return replace(
            self,
            rows=np.concatenate([self.rows, rows]),
            offsets=np.concatenate([self.offsets, offsets]),
            loose=np.concatenate([self.loose, np.ones_like(offsets)]),
        )

    def at(self, action: Array) -> Array:
        """Return x ``(n, B)`` at actions ``(B, d)``, with a slack of 0 and exact terms of sums."""
        return self.lifted((action.T - self.middle) / self.half)

    def lifted(self, point: Array) -> Array:
        """Return what `at` does, from actions in half widths about the middle, ``(d, B)``."""
        x = np.zeros(self.rows.shape[1:])
        x[: self.dim] = point
        if terms := len(self.reach):
            rooms = self.offsets[: 2 * terms] - times(self.rows[: 2 * terms], x)
            x[self.dim + 1 :] = np.maximum(-rooms[:terms], -rooms[terms:])
        return x

    def action(self, x: Array) -> Array:
        """Return the actions ``(B, d)`` of unknowns."""
        return np.ascontiguousarray((self.middle + self.half * x[: self.dim]).T)

    def start(self, action: Array) -> Array:
        """Return x strictly inside at an action, its slack below the largest there."""
        x = self.at(action)
        x[self.dim] = self.slack_of(x) - START
        if terms := len(self.reach):
            sums = slice(2 * terms, 2 * terms + terms // self.dim)
            room = self.offsets[sums] - times(self.rows[sums], x)
            x[self.dim + 1 :] += np.repeat(room / (2 * self.dim), self.dim, 0)
        return x

    def rooms(self, x: Array) -> Array:
        """Return by how much sums, rows and cones hold, ``(R, B)``."""
        first = 2 * len(self.reach)
        rooms = self.offsets[first:] - times(self.rows[first:], x)
        if not len(self.cones):
            return rooms
        height = self.tips - times(self.cones, x)
        return np.concatenate([rooms, height[:, 0] - length(height[:, 1:])])

    def slack(self, action: Array) -> Array:
        """Return the smallest slack at an action of what is maximized, ``(B,)``."""
        return self.slack_of(self.at(action)) * self.unit

    def slack_of(self, x: Array) -> Array:
        """Return the largest t at the actions and terms of x, ``(B,)``, in units."""
        return x[self.dim] + np.where(self.rates() > 0, self.rooms(x), np.inf).min(0)

    def rates(self) -> Array:
        """Return 1 for the maximized sums, rows and cones, ``(R, B)``."""
        rows = self.rows[2 * len(self.reach) :, self.dim]
        return np.concatenate([rows, self.cones[:, 0, self.dim]])

    def bound(self) -> Array:
        """Return upper bounds of the smallest slack, from each slack's own range, ``(B,)``."""
        dim, first = self.dim, 2 * len(self.reach)
        most = self.offsets[first:] + np.abs(self.rows[first:, :dim]).sum(1)
        reach = length(self.cones[:, 1:, :dim]).sum(1)
        nearest = np.maximum(length(self.tips[:, 1:]) - reach, 0)
        most = np.concatenate([most, self.tips[:, 0] - nearest])
        return np.where(self.rates() > 0, most, np.inf).min(0)


def batch_last(value: Tensor, events: int) -> Array:
    """Return values ``(B, *event)`` or, the same for all, ``(*event,)`` as ``(*event, B or 1)``."""
    array: Array = value.detach().numpy()
    return array[..., None] if array.ndim == events else array.transpose(*range(1, events + 1), 0)


def times(matrix: Array, x: Array) -> Array:
    """Return the product of matrices ``(..., m, n, B)`` with vectors ``(n, B)``."""
    return np.asarray(np.einsum("...ib,ib->...b", matrix, x), dtype=np.float64)


def length(vector: Array) -> Array:
    """Return the norms ``(J, ..., B)`` of vectors ``(J, k, ..., B)``."""
    return np.asarray(np.sqrt(np.square(vector).sum(1)), dtype=np.float64)
