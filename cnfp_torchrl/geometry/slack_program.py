"""Problems of the largest smallest slack: stacks of rows, cones and kinked sums, and barriers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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

    Fields carry B first; each kind has a weight of 1, or of 0 where it is to be ignored.
    """

    rows: Tensor
    row_offsets: Tensor
    row_rates: Tensor
    row_weights: Tensor
    matrices: Tensor
    vectors: Tensor
    cone_sizes: Tensor
    cone_rates: Tensor
    cone_weights: Tensor
    upper: Tensor
    lower: Tensor
    sum_sizes: Tensor
    sum_rates: Tensor
    sum_weights: Tensor

    @classmethod
    def stack(cls, parts: Sequence[Superlevel], active: Tensor) -> Self:
        """Stack descriptions, each with batch shape ``(B,)``, of which some are active.

        Args:
            parts: one description for each set.
            active: boolean ``(B, len(parts))``.
        """
        batch, like = active.shape[0], active.new_zeros((), dtype=torch.float64)
        flags = active.to(like).unsqueeze(-1).unbind(1)
        rows = [(p, on) for p, on in zip(parts, flags, strict=True) if isinstance(p, Rows)]
        cones = [(p, on) for p, on in zip(parts, flags, strict=True) if isinstance(p, Cone)]
        sums = [(p, on) for p, on in zip(parts, flags, strict=True) if isinstance(p, KinkedSum)]
        dim = rows[0][0].normals.shape[-1]
        height = max((p.matrix.shape[-2] for p, _ in cones), default=0)

        def joined(pieces: list[Tensor], *shape: int) -> Tensor:
            """Concatenate pieces ``(*B, ...)`` along their first event dimension."""
            if not pieces:
                return like.new_zeros(batch, 0, *shape)
            sizes = [piece.shape[-1 - len(shape) :] for piece in pieces]
            return torch.cat([p.expand(batch, *n) for p, n in zip(pieces, sizes, strict=True)], 1)

        offsets = joined([p.offsets for p, _ in rows])
        finite = offsets.isfinite()
        return cls(
            rows=joined([p.normals for p, _ in rows], dim),
            row_offsets=torch.where(finite, offsets, 1.0),
            row_rates=joined([p.rates for p, _ in rows]),
            row_weights=finite * joined([on.expand(batch, p.offsets.shape[-1]) for p, on in rows]),
            matrices=joined(
                [_rows_padded(p.matrix, height, -2)[..., None, :, :] for p, _ in cones], height, dim
            ),
            vectors=joined(
                [_rows_padded(p.vector, height, -1)[..., None, :] for p, _ in cones], height
            ),
            cone_sizes=joined([p.size[..., None] for p, _ in cones]),
            cone_rates=joined([p.rate[..., None] for p, _ in cones]),
            cone_weights=joined([on for _, on in cones]),
            upper=joined([torch.maximum(p.upper, p.lower)[..., None, :] for p, _ in sums], dim),
            lower=joined([torch.minimum(p.upper, p.lower)[..., None, :] for p, _ in sums], dim),
            sum_sizes=joined([p.size[..., None] for p, _ in sums]),
            sum_rates=joined([p.rate[..., None] for p, _ in sums]),
            sum_weights=joined([on for _, on in sums]),
        )

    def select(self, keep: Tensor) -> Self:
        """Return some of the B problems."""
        return type(self)(**{f.name: getattr(self, f.name)[keep] for f in fields(self)})

    def with_rows(self, normals: Tensor, offsets: Tensor, weights: Tensor) -> Self:
        """Return the problems with rows ``(B, m, d)``, of rate one, added."""
        return replace(
            self,
            rows=torch.cat([self.rows, normals], 1),
            row_offsets=torch.cat([self.row_offsets, offsets], 1),
            row_rates=torch.cat([self.row_rates, torch.ones_like(offsets)], 1),
            row_weights=torch.cat([self.row_weights, weights], 1),
        )

    def barrier_parameter(self) -> Tensor:
        """Return nu, ``(B,)``: one for each row, two for each cone, two a kinked term."""
        terms = 2 * self.upper.shape[-1] + 1
        weights = (self.row_weights.sum(-1), 2 * self.cone_weights.sum(-1))
        return weights[0] + weights[1] + terms * self.sum_weights.sum(-1)

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
        rows = self.row_offsets - torch.einsum("bmd,...bd->...bm", self.rows, action)
        cones = self.cone_sizes - vector_norm(self.white(action), dim=-1)
        sums = self.sum_sizes - self._terms(action).sum(-1)
        return torch.cat([rows, cones, sums], -1)

    def _smallest(self, rooms: Tensor) -> Tensor:
        """Return the smallest slack of those that rooms leave."""
        rates = torch.cat([self.row_rates, self.cone_rates, self.sum_rates], -1)
        weights = torch.cat([self.row_weights, self.cone_weights, self.sum_weights], -1)
        counts = (weights > 0) & (rates > 0)
        return torch.where(counts, rooms / torch.where(counts, rates, 1.0), torch.inf).amin(-1)

    def start(self, action: Tensor, margin: Tensor) -> Point:
        """Return a strictly feasible point at an action, its slack a margin below the possible."""
        slack = self.slack(action) - margin
        terms = self._terms(action)
        room = self.sum_sizes - self.sum_rates * slack.unsqueeze(-1) - terms.sum(-1)
        return Point(action, slack, terms + (room / (2 * action.shape[-1])).unsqueeze(-1))

    def barrier(self, at: Point) -> Tensor:
        """Return the barrier's value ``(*trials, B)``, infinite where a point is not feasible."""
        s = self.distances(at)
        value = weigh(self.row_weights, s.rows, torch.log).sum(-1)
        for gaps in (s.cone_gaps, s.cone_sums):
            value = value + weigh(self.cone_weights, gaps, torch.log).sum(-1)
        value = value + weigh(self.sum_weights, s.sums, torch.log).sum(-1)
        for terms in (s.upper, s.lower):
            value = value + weigh(self.sum_weights.unsqueeze(-1), terms, torch.log).sum((-2, -1))
        return torch.where(torch.isnan(value), torch.inf, -value)

    def distances(self, at: Point) -> Distances:
        """Return by how much each inequality holds; none may be negative."""
        action, slack = at.action.unsqueeze(-2), at.slack.unsqueeze(-1)
        height = self.cone_sizes - self.cone_rates * slack
        length = vector_norm(self.white(at.action), dim=-1)
        return Distances(
            rows=self.row_offsets
            - torch.einsum("bmd,...bd->...bm", self.rows, at.action)
            - self.row_rates * slack,
            cone_gaps=height - length,
            cone_sums=height + length,
            upper=at.terms - self.upper * action,
            lower=at.terms - self.lower * action,
            sums=self.sum_sizes - self.sum_rates * slack - at.terms.sum(-1),
        )

    def white(self, action: Tensor) -> Tensor:
        """Return ``W a + y`` of each cone, ``(*trials, B, J, k)``."""
        return torch.einsum("bjkd,...bd->...bjk", self.matrices, action) + self.vectors

    def _terms(self, action: Tensor) -> Tensor:
        action = action.unsqueeze(-2)
        return torch.maximum(self.upper * action, self.lower * action)


def weigh(weights: Tensor, values: Tensor, function: Callable[[Tensor], Tensor]) -> Tensor:
    """Return a function of the values where the weight is 1, and 0 where it is 0."""
    counts = weights > 0
    return torch.where(counts, function(torch.where(counts, values, 1.0)), 0.0)


def _rows_padded(tensor: Tensor, height: int, axis: int) -> Tensor:
    missing = height - tensor.shape[axis]
    return pad(tensor, (0, missing) if axis == -1 else (0, 0, 0, missing))
