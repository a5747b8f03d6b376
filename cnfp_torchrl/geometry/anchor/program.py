"""Problems of the largest smallest slack: stacks of rows, cones and kinked sums, and barriers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple, Self

import torch
from torch import Tensor
from torch.linalg import vector_norm
from torch.nn.functional import pad

from cnfp_torchrl.geometry.norms import spectral_norm_bound
from cnfp_torchrl.geometry.superlevel import Cone, KinkedSum, Rows, Superlevel


class Point(NamedTuple):
    """Primal variables: action ``(B, d)``, slack ``(B,)``, kinked terms' bounds ``(B, L, d)``."""

    action: Tensor
    slack: Tensor
    terms: Tensor

    def moved(self, by: Point, step: Tensor) -> Point:
        """Return the point at a step ``(*trials, B)`` along a direction."""
        along = step.unsqueeze(-1)
        return Point(
            self.action + along * by.action,
            self.slack + step * by.slack,
            self.terms + along.unsqueeze(-1) * by.terms,
        )


class Distances(NamedTuple):
    """Distances of a point from each inequality: rows, cones' two factors, kinked sums' three."""

    rows: Tensor
    cone_gaps: Tensor
    cone_sums: Tensor
    upper: Tensor
    lower: Tensor
    sums: Tensor


@dataclass(frozen=True, eq=False)
class Program:
    """B problems "maximize t such that all sets have slack t", as stacks of rows, cones and sums.

    Fields carry B first. An inequality has a rate of 0 where it must hold whatever t is. One that
    does not count has no coefficients, a size of 1 and a rate of 0: it holds by 1 everywhere.
    """

    rows: Tensor
    row_offsets: Tensor
    row_rates: Tensor
    matrices: Tensor
    vectors: Tensor
    cone_sizes: Tensor
    cone_rates: Tensor
    upper: Tensor
    lower: Tensor
    sum_sizes: Tensor
    sum_rates: Tensor

    @classmethod
    def stack(cls, parts: Sequence[Superlevel], batch: int) -> Self:
        """Stack descriptions, each with batch shape ``(B,)``: all rows, all cones, all sums.

        Args:
            parts: descriptions, one for each set, at least one of them with rows.
            batch: number B of problems.
        """
        rows = [part for part in parts if isinstance(part, Rows)]
        cones = [part for part in parts if isinstance(part, Cone)]
        sums = [part for part in parts if isinstance(part, KinkedSum)]
        like, dim = rows[0].normals, rows[0].normals.shape[-1]
        height = max((part.matrix.shape[-2] for part in cones), default=0)

        def joined(pieces: list[Tensor], *shape: int) -> Tensor:
            """Concatenate pieces ``(*B, ...)`` along their first event dimension."""
            if not pieces:
                return like.new_zeros(batch, 0, *shape)
            sizes = [piece.shape[-1 - len(shape) :] for piece in pieces]
            return torch.cat([p.expand(batch, *n) for p, n in zip(pieces, sizes, strict=True)], 1)

        program = cls(
            rows=joined([p.normals for p in rows], dim),
            row_offsets=joined([p.offsets for p in rows]),
            row_rates=joined([p.rates for p in rows]),
            matrices=joined(
                [_rows_padded(p.matrix, height, -2)[..., None, :, :] for p in cones], height, dim
            ),
            vectors=joined(
                [_rows_padded(p.vector, height, -1)[..., None, :] for p in cones], height
            ),
            cone_sizes=joined([p.size[..., None] for p in cones]),
            cone_rates=joined([p.rate[..., None] for p in cones]),
            upper=joined([torch.maximum(p.upper, p.lower)[..., None, :] for p in sums], dim),
            lower=joined([torch.minimum(p.upper, p.lower)[..., None, :] for p in sums], dim),
            sum_sizes=joined([p.size[..., None] for p in sums]),
            sum_rates=joined([p.rate[..., None] for p in sums]),
        )
        # Infinite offsets and sums without weights let every action pass.
        finite, cones_count = program.row_offsets.isfinite(), program.cone_rates > 0
        return program._where(finite, cones_count, program.sum_rates > 0)

    def requiring(self, required: Tensor, trial: Tensor, counts: Tensor) -> Self:
        """Return the problems "maximize t such that all slacks exceed what is required by t".

        Args:
            required: slacks ``(B, M)`` required of all inequalities, in their order.
            trial: flags of those that exceed it by t, 1 or 0; the others need no more than it.
            counts: flags of those that count at all, 1 or 0.
        """
        sizes = [self.row_rates.shape[-1], self.cone_rates.shape[-1], self.sum_rates.shape[-1]]
        needs, trials, on = (rows.split(sizes, -1) for rows in (required, trial, counts))
        shifted = replace(
            self,
            row_offsets=self.row_offsets - self.row_rates * needs[0],
            row_rates=self.row_rates * trials[0],
            cone_sizes=self.cone_sizes - self.cone_rates * needs[1],
            cone_rates=self.cone_rates * trials[1],
            sum_sizes=self.sum_sizes - self.sum_rates * needs[2],
            sum_rates=self.sum_rates * trials[2],
        )
        return shifted._where(*(flags > 0 for flags in on))

    def _where(self, rows: Tensor, cones: Tensor, sums: Tensor) -> Self:
        """Return the problems of the inequalities that count."""

        def kept(value: Tensor, mask: Tensor, otherwise: float = 0.0) -> Tensor:
            return torch.where(mask[(...,) + (None,) * (value.ndim - mask.ndim)], value, otherwise)

        return type(self)(
            rows=kept(self.rows, rows),
            row_offsets=kept(self.row_offsets, rows, 1.0),
            row_rates=kept(self.row_rates, rows),
            matrices=kept(self.matrices, cones),
            vectors=kept(self.vectors, cones),
            cone_sizes=kept(self.cone_sizes, cones, 1.0),
            cone_rates=kept(self.cone_rates, cones),
            upper=kept(self.upper, sums),
            lower=kept(self.lower, sums),
            sum_sizes=kept(self.sum_sizes, sums, 1.0),
            sum_rates=kept(self.sum_rates, sums),
        )

    @property
    def has_cones(self) -> bool:
        """Whether there are any second-order cones."""
        return self.matrices.shape[1] > 0

    @property
    def has_sums(self) -> bool:
        """Whether there are any kinked sums."""
        return self.upper.shape[1] > 0

    def select(self, keep: Tensor) -> Self:
        """Return some of the B problems."""
        return type(self)(**{f.name: getattr(self, f.name)[keep] for f in fields(self)})

    def with_rows(self, normals: Tensor, offsets: Tensor, rates: Tensor, counts: Tensor) -> Self:
        """Return the problems with rows ``(B, m, d)`` added, where they count."""
        return replace(
            self,
            rows=torch.cat([self.rows, normals * counts.unsqueeze(-1)], 1),
            row_offsets=torch.cat([self.row_offsets, torch.where(counts, offsets, 1.0)], 1),
            row_rates=torch.cat([self.row_rates, rates * counts], 1),
        )

    def barrier_parameter(self) -> int:
        """Return nu: one for each row, two for each cone, two and one a kinked sum's terms."""
        terms = 2 * self.upper.shape[-1] + 1
        return self.rows.shape[1] + 2 * self.matrices.shape[1] + terms * self.upper.shape[1]

    def slack(self, action: Tensor) -> Tensor:
        """Return the smallest slack at an action, ``(B,)``."""
        return self._smallest(self._rooms(action))

    def bound_within(self, action: Tensor, distance: Tensor) -> Tensor:
        """Return an upper bound of the smallest slack within a distance of an action, ``(B,)``."""
        kinks = torch.maximum(self.upper.abs(), self.lower.abs())
        steepness = torch.cat(
            [
                vector_norm(self.rows, dim=-1),
                spectral_norm_bound(self.matrices),
                vector_norm(kinks, dim=-1),
            ],
            -1,
        )
        return self._smallest(self._rooms(action) + steepness * distance.unsqueeze(-1))

    def _rooms(self, action: Tensor) -> Tensor:
        """Return by how much each inequality holds at a slack of zero."""
        rows = self.row_offsets - (self.rows @ action.unsqueeze(-1)).squeeze(-1)
        cones = self.cone_sizes - vector_norm(self.white(action), dim=-1)
        sums = self.sum_sizes - self._terms(action).sum(-1)
        return torch.cat([rows, cones, sums], -1)

    def _smallest(self, rooms: Tensor) -> Tensor:
        """Return the smallest slack of those that rooms leave."""
        rates = torch.cat([self.row_rates, self.cone_rates, self.sum_rates], -1)
        return torch.where(rates > 0, rooms / rates, torch.inf).amin(-1)

    def start(self, action: Tensor, margin: Tensor) -> Point:
        """Return a strictly feasible point at an action, its slack a margin below the possible."""
        slack = self.slack(action) - margin
        terms = self._terms(action)
        room = self.sum_sizes - self.sum_rates * slack.unsqueeze(-1) - terms.sum(-1)
        return Point(action, slack, terms + (room / (2 * action.shape[-1])).unsqueeze(-1))

    def gained(self, s: Distances) -> Tensor:
        """Return by how much t could be larger at the action of a point, ``(B,)``."""
        parts = [s.rows / self.row_rates]
        if self.has_cones:
            parts.append(s.cone_gaps / self.cone_rates)
        if self.has_sums:
            parts.append(s.sums / self.sum_rates)
        return (torch.cat(parts, -1) if len(parts) > 1 else parts[0]).amin(-1)

    def barrier(self, s: Distances) -> Tensor:
        """Return the barrier's value ``(*trials, B)``, infinite where a point is not feasible."""
        value = s.rows.log().sum(-1)
        if self.has_cones:
            value = value + (s.cone_gaps.log() + s.cone_sums.log()).sum(-1)
        if self.has_sums:
            value = value + s.sums.log().sum(-1)
            value = value + (s.upper.log() + s.lower.log()).sum((-2, -1))
        return -value.nan_to_num(nan=-torch.inf, posinf=torch.inf)

    def distances(self, at: Point) -> Distances:
        """Return by how much each inequality holds; none may be negative."""
        slack = at.slack.unsqueeze(-1)
        rows = self.row_offsets - self.row_rates * slack
        rows = rows - (self.rows @ at.action.unsqueeze(-1)).squeeze(-1)
        gaps = sums = upper = lower = totals = rows[..., :0]
        if self.has_cones:
            height = self.cone_sizes - self.cone_rates * slack
            length = vector_norm(self.white(at.action), dim=-1)
            gaps, sums = height - length, height + length
        if self.has_sums:
            action = at.action.unsqueeze(-2)
            upper, lower = at.terms - self.upper * action, at.terms - self.lower * action
            totals = self.sum_sizes - self.sum_rates * slack - at.terms.sum(-1)
        return Distances(rows, gaps, sums, upper, lower, totals)

    def white(self, action: Tensor) -> Tensor:
        """Return ``W a + y`` of each cone, ``(*trials, B, J, k)``."""
        return (self.matrices @ action[..., None, :, None]).squeeze(-1) + self.vectors

    def _terms(self, action: Tensor) -> Tensor:
        action = action.unsqueeze(-2)
        return torch.maximum(self.upper * action, self.lower * action)


def _rows_padded(tensor: Tensor, height: int, axis: int) -> Tensor:
    missing = height - tensor.shape[axis]
    return pad(tensor, (0, missing) if axis == -1 else (0, 0, 0, missing))
