r"""Problems of the largest smallest slack, as rows and second-order cones in one vector x.

A problem's unknowns are :math:`x = (a, t, u)`: the action in half widths of the bounds about their
middle, the slack t in mean half widths, and bounds u of the terms of kinked sums, of which each
makes two rows, :math:`\alpha_i a_i \le u_i` and :math:`\beta_i a_i \le u_i`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Self

import torch
from torch import Tensor
from torch.linalg import vector_norm
from torch.nn.functional import pad

from cnfp_torchrl.geometry.box import Box
from cnfp_torchrl.geometry.superlevel import Cone, KinkedSum, Rows, Superlevel


@dataclass(frozen=True, eq=False)
class Program:
    """B problems "maximize t such that all sets have slack t".

    Fields carry B first. All slacks grow at the rate of one: a row or cone with a 0 for t must hold
    whatever t is. One that does not count has no coefficients, and holds by 1 everywhere.

    Args:
        rows: coefficients of ``rows @ x <= offsets``, ``(B, M, n)``: the terms of kinked sums, the
            sums, and other rows.
        offsets: offsets of the rows, ``(B, M, 1)``.
        loose: offsets that let every action pass, for rows that do not count, ``(B, M, 1)``.
        cones: coefficients of ``tips - cones @ x``, whose first component is no less than the norm
            of the others, ``(B, J, 1 + k, n)``.
        tips: constants of the cones, ``(B, J, 1 + k, 1)``.
        middle: middles of the bounds, ``(B, d)``.
        half: half widths of the bounds, ``(B, d)``.
        unit: mean half widths, ``(B, 1)``.
        term_reach: half of the ranges within which the terms of sums lie, ``(B, n - d - 1)``; these
            begin at 0.
    """

    rows: Tensor
    offsets: Tensor
    loose: Tensor
    cones: Tensor
    tips: Tensor
    middle: Tensor
    half: Tensor
    unit: Tensor
    term_reach: Tensor

    @classmethod
    def stack(cls, parts: Sequence[Superlevel], bounds: Box) -> Self:
        """Stack descriptions, each with batch shape ``(B,)``: kinked sums, rows and cones.

        Args:
            parts: descriptions, one for each set, at least one of them with rows.
            bounds: finite bounds of the actions, ``(B, d)``.
        """
        rows = [part for part in parts if isinstance(part, Rows)]
        cones = [part for part in parts if isinstance(part, Cone)]
        sums = [part for part in parts if isinstance(part, KinkedSum)]
        batch, dim = bounds.low.shape
        middle, half = (bounds.low + bounds.high) / 2, (bounds.high - bounds.low) / 2
        unit = half.mean(-1, keepdim=True)
        width, terms = dim + 1 + len(sums) * dim, len(sums) * dim
        stacked = middle.new_zeros(batch, 2 * terms + len(sums), width)
        offsets = torch.zeros_like(stacked[..., 0])
        reaches = [middle.new_zeros(batch, 0)]
        for i, part in enumerate(sums):
            rate = (part.rate.masked_fill(part.rate == 0, 1) * unit.squeeze(-1)).unsqueeze(-1)
            own = slice(dim + 1 + i * dim, dim + 1 + (i + 1) * dim)
            for j, slope in enumerate((part.upper / rate, part.lower / rate)):
                first = j * terms + i * dim
                stacked[:, first : first + dim, :dim] = torch.diag_embed(slope * half)
                stacked[:, first : first + dim, own] = -torch.eye(dim).to(middle)
                offsets[:, first : first + dim] = -slope * middle
            stacked[:, 2 * terms + i, own] = 1
            size = (part.size.unsqueeze(-1) / rate).squeeze(-1)
            offsets[:, 2 * terms + i] = torch.where(part.rate > 0, size, torch.inf)
            steepest = torch.maximum(part.upper.abs(), part.lower.abs()) / rate
            reaches.append(steepest * torch.maximum(bounds.low.abs(), bounds.high.abs()) / 2)
        reach = torch.cat(reaches, -1)
        loose = torch.ones_like(offsets)
        loose[:, 2 * terms :] = 3 + 4 * reach.view(batch, len(sums), dim).sum(-1)
        normals = torch.cat(
            [(p.normals / p.rates.unsqueeze(-1)).expand(batch, -1, -1) for p in rows], 1
        )
        far = torch.cat([(p.offsets / p.rates).expand(batch, -1) for p in rows], 1)
        far = (far - (normals @ middle.unsqueeze(-1)).squeeze(-1)) / unit
        normals = normals * (half / unit).unsqueeze(-2)
        height = max((part.matrix.shape[-2] for part in cones), default=0)
        stacked_cones = middle.new_zeros(batch, len(cones), 1 + height, width)
        tips = torch.zeros_like(stacked_cones[..., :1])
        for i, cone in enumerate(cones):
            rate = cone.rate * unit.squeeze(-1)
            matrix = cone.matrix / rate[..., None, None]
            vector = cone.vector / rate.unsqueeze(-1) + (matrix @ middle.unsqueeze(-1)).squeeze(-1)
            stacked_cones[:, i, 1 : 1 + matrix.shape[-2], :dim] = -matrix * half.unsqueeze(-2)
            tips[:, i, 1 : 1 + matrix.shape[-2], 0] = vector
            tips[:, i, 0, 0] = cone.size / rate
        return cls(
            rows=torch.cat([stacked, pad(normals, (0, 1 + terms))], 1),
            offsets=torch.cat([offsets, far], 1).unsqueeze(-1),
            loose=torch.cat([loose, torch.ones_like(far)], 1).unsqueeze(-1),
            cones=stacked_cones,
            tips=tips,
            middle=middle,
            half=half,
            unit=unit,
            term_reach=reach,
        )

    def requiring(self, required: Tensor, trial: Tensor, counts: Tensor) -> Self:
        """Return the problems "maximize t such that all slacks exceed what is required by t".

        Args:
            required: slacks ``(B, R)`` required of all sums, rows and cones, in this order.
            trial: flags of those that exceed it by t, boolean; the others need no more than it.
            counts: flags of those that count at all, boolean.
        """
        first, dim = self.terms, self.dim
        sizes = [self.rows.shape[1] - first, self.cones.shape[1]]
        needs, tried, on = (
            flags.unsqueeze(-1).split(sizes, 1) for flags in (required / self.unit, trial, counts)
        )
        offsets, loose = self.offsets[:, first:], self.loose[:, first:]
        row_on, cone_on = on[0] & offsets.isfinite(), on[1].unsqueeze(-1)
        kept = row_on.clone()
        # Sums keep the terms, which nothing else bounds.
        kept[:, : first // (2 * dim)] = True
        rows = torch.cat([self.rows[:, :first], self.rows[:, first:] * kept], 1)
        rows[:, first:, dim] = (tried[0] & row_on).squeeze(-1).to(rows)
        cones = self.cones * cone_on
        cones[:, :, 0, dim] = (tried[1] & on[1]).squeeze(-1).to(cones)
        tips = self.tips.masked_fill(~cone_on, 0)
        tips[:, :, 0] = torch.where(on[1], self.tips[:, :, 0] - needs[1], 1)
        offsets = torch.where(row_on, offsets - needs[0], loose)
        return replace(
            self,
            rows=rows,
            offsets=torch.cat([self.offsets[:, :first], offsets], 1),
            cones=cones,
            tips=tips,
        )

    @property
    def dim(self) -> int:
        """The dimension d of the actions."""
        return self.middle.shape[-1]

    @property
    def terms(self) -> int:
        """The number of rows that bound the terms of sums."""
        return 2 * self.term_reach.shape[-1]

    def select(self, keep: Tensor) -> Self:
        """Return some of the B problems."""
        return type(self)(**{f.name: getattr(self, f.name)[keep] for f in fields(self)})

    def with_rows(self, normals: Tensor, offsets: Tensor, trial: Tensor, counts: Tensor) -> Self:
        """Return the problems with rows added, where they count.

        Args:
            normals: normals of the rows, ``(B, m, d)``, of slacks that are no further divided.
            offsets: offsets of the rows, ``(B, m)``.
            trial: flags of the rows on trial, boolean ``(B, m)``.
            counts: flags of the rows that count, boolean ``(B, m)``.
        """
        offsets = (offsets - (normals @ self.middle.unsqueeze(-1)).squeeze(-1)) / self.unit
        rows = pad(normals * (self.half / self.unit).unsqueeze(-2), (0, 1 + self.terms // 2))
        rows[..., self.dim] = trial.to(rows)
        rows = rows * counts.unsqueeze(-1)
        offsets = torch.where(counts, offsets, 1.0).unsqueeze(-1)
        return replace(
            self,
            rows=torch.cat([self.rows, rows], 1),
            offsets=torch.cat([self.offsets, offsets], 1),
            loose=torch.cat([self.loose, torch.ones_like(offsets)], 1),
        )

    def at(self, action: Tensor) -> Tensor:
        """Return x ``(B, n, 1)`` at an action, with a slack of 0 and exact terms of all sums."""
        dim, first = self.dim, self.terms
        place = ((action - self.middle) / self.half).unsqueeze(-1)
        x = pad(place, (0, 0, 0, self.rows.shape[-1] - dim))
        if first:
            rooms = self.offsets[:, :first] - self.rows[:, :first] @ x
            x[:, dim + 1 :] = torch.maximum(*(-rooms).chunk(2, 1))
        return x

    def action(self, x: Tensor) -> Tensor:
        """Return the actions ``(B, d)`` of unknowns."""
        return torch.addcmul(self.middle, self.half, x[:, : self.dim, 0])

    def start(self, action: Tensor) -> Tensor:
        """Return x strictly inside at an action, its slack a mean half width below the possible."""
        x = self.at(action)
        x[:, self.dim] = (self.slack_of(x) - 1).unsqueeze(-1)
        if self.terms:
            first, count = self.terms, self.terms // (2 * self.dim)
            sums = slice(first, first + count)
            room = self.offsets[:, sums] - self.rows[:, sums] @ x
            x[:, self.dim + 1 :] += (room / (2 * self.dim)).repeat_interleave(self.dim, 1)
        return x

    def slack(self, action: Tensor) -> Tensor:
        """Return the smallest slack at an action of what is on trial, ``(B,)``."""
        return self.slack_of(self.at(action)) * self.unit.squeeze(-1)

    def slack_of(self, x: Tensor) -> Tensor:
        """Return the largest t at the actions and terms of x, ``(B,)``, in units."""
        rooms = self.offsets - self.rows @ x
        least = _of_trial(rooms, self.rows[:, :, self.dim]).amin((1, 2))
        if self.cones.shape[1]:
            heights = self.tips - self.cones @ x.unsqueeze(1)
            rooms = heights[:, :, 0] - vector_norm(heights[:, :, 1:], dim=2)
            least = torch.minimum(
                least, _of_trial(rooms, self.cones[:, :, 0, self.dim]).amin((1, 2))
            )
        return least + x[:, self.dim, 0]

    def bound(self) -> Tensor:
        """Return upper bounds of what each of the slacks can be within the bounds, ``(B,)``."""
        dim = self.dim
        rooms = self.offsets + self.rows[..., :dim].abs().sum(-1, keepdim=True)
        least = _of_trial(rooms, self.rows[:, :, dim]).amin((1, 2))
        if self.cones.shape[1]:
            reach = vector_norm(self.cones[:, :, 1:, :dim], dim=2).sum(-1, keepdim=True)
            near = (vector_norm(self.tips[:, :, 1:], dim=2) - reach).relu()
            rooms = _of_trial(self.tips[:, :, 0] - near, self.cones[:, :, 0, dim])
            least = torch.minimum(least, rooms.amin((1, 2)))
        return least


def _of_trial(rooms: Tensor, rates: Tensor) -> Tensor:
    """Return rooms ``(B, M, 1)``, infinite where the rate of t is 0."""
    return rooms.masked_fill((rates == 0).unsqueeze(-1), torch.inf)
