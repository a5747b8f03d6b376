"""The example that a family is checked with: sets, anchors inside them, and rays from those."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import torch
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.geometry import Box, ConstraintSet, row_depths

DTYPES = (torch.float32, torch.float64)

_DEPTHS = (0.3, 1e-1, 1e-2, 1e-3, 1e-4, 1e-5)
"""Distances from the boundary at which further anchors are tried, as shares of the whole ray."""


class Rays(NamedTuple):
    """Rays from an anchor to the action bounds.

    Args:
        anchor: Origins of the rays, ``(B, d)``.
        directions: Vectors from the anchor to about the bounds, ``(N, B, d)``.
    """

    anchor: Tensor
    directions: Tensor

    def cast(self, dtype: torch.dtype) -> Rays:
        """Return the rays in a dtype."""
        return Rays(self.anchor.to(dtype), self.directions.to(dtype))

    def ends(self, gauge: Tensor) -> Tensor:
        """Return the points at which a set of that gauge ends, ``anchor + direction / gauge``."""
        return self.anchor + self.directions / gauge.unsqueeze(-1)


@dataclass(frozen=True)
class Example:
    """Sets and rays inside them, with a flat batch, in float64, of numbers that float32 holds too.

    Args:
        sets: Sets of the family, of batch shape ``(B,)``.
        bounds: The finite action bounds around the anchors, of batch shape ``(B,)``.
        rays: Rays from each anchor, those from the given one first.
        random: The generator of all random numbers.
    """

    sets: ConstraintSet
    bounds: Box
    rays: tuple[Rays, ...]
    random: torch.Generator

    @classmethod
    def of(
        cls, sets: ConstraintSet, anchor: Tensor, bounds: Box | None, samples: int, seed: int
    ) -> Self:
        """Make an example of sets and anchors whose shapes are known to be right.

        Raises:
            ValueError: when the bounds are not finite or do not hold the anchors.
        """
        batch = torch.broadcast_shapes(sets.batch_shape, anchor.shape[:-1])
        index = torch.arange(batch.numel(), device=anchor.device)
        flat = sets.select(batch, index).with_fields(lambda field, _: _rounded(field))
        anchor = _rounded(anchor.detach().expand(*batch, -1).reshape(-1, anchor.shape[-1]))
        random = torch.Generator().manual_seed(seed)
        if bounds is None:
            bounds = _bounds_around(flat, anchor, random)
        else:
            bounds = bounds.select(batch, index).with_fields(lambda field, _: _rounded(field))
        if not bool((bounds.slack(anchor) > 0).all() and bounds.magnitude().isfinite().all()):
            raise ValueError(
                "bounds: expected finite action bounds with the anchors strictly inside, given "
                f"low {bounds.low.tolist()}, high {bounds.high.tolist()}"
            )
        example = cls(flat, bounds, (), random)
        return replace(example, rays=(example.rays_from(anchor, example.directions(samples)),))

    @property
    def size(self) -> Tensor:
        """The largest coordinate of any action within the bounds, ``(B,)``."""
        return self.bounds.magnitude()

    def cast(self, dtype: torch.dtype) -> tuple[Box, ConstraintSet]:
        """Return bounds and sets in a dtype."""
        return self.bounds.to(dtype), self.sets.to(dtype)

    def normal(self, *shape: int) -> Tensor:
        """Return standard normal numbers in float64."""
        drawn = torch.randn(*shape, generator=self.random, dtype=torch.float64)
        return drawn.to(self.bounds.low.device)

    def uniform(self, *shape: int) -> Tensor:
        """Return numbers between 0 and 1 in float64."""
        drawn = torch.rand(*shape, generator=self.random, dtype=torch.float64)
        return drawn.to(self.bounds.low.device)

    def directions(self, count: int) -> Tensor:
        """Return directions ``(count, B, d)``: Gaussian, on axes, diagonal, and nearly on axes."""
        gauss = self.normal(count, *self.bounds.low.shape)
        largest = gauss.abs() == gauss.abs().amax(-1, keepdim=True)
        axis = torch.where(largest, gauss, 0.0)
        kinds = torch.stack([gauss, axis, gauss.sign(), axis + 1e-6 * gauss, gauss])
        index = torch.arange(count, device=gauss.device)
        return kinds[index % len(kinds), index]

    def rays_from(self, anchor: Tensor, directions: Tensor) -> Rays:
        """Return rays from an anchor ``(B, d)`` in directions ``(N, B, d)``, none of them zero."""
        room = self.bounds.gauge(directions, anchor).unsqueeze(-1)
        return Rays(anchor, _rounded(directions / room))

    def actions(self, count: int) -> Tensor:
        """Return actions ``(count, B, d)`` up to twice as far as the bounds, at all distances."""
        anchor = self.rays[0].anchor
        to_bounds = self.rays_from(anchor, self.directions(count)).directions
        return anchor + to_bounds * 2 * 1e-4 ** self.uniform(count, len(anchor), 1)

    def with_anchors_near_the_boundary(self, samples: int) -> Self:
        """Return the example with four anchors more, as near the boundary as a search may put them.

        Some rays from them lead straight to the boundary, away from it and along it: there a gauge
        that subtracts large numbers is worst.
        """
        given = self.rays[0].anchor
        both = (self.bounds, self.sets)
        # Depths of float32, not of the smaller rounding errors of float64.
        depths = row_depths([constraint_set.to(torch.float32) for constraint_set in both])
        rays = [self.rays[0]]
        for direction in self.directions(4):
            gauge = torch.maximum(*(s.gauge(direction, given) for s in both)).unsqueeze(-1)
            anchor = given
            for depth in _DEPTHS:
                trial = _rounded(given + direction * (1 - depth) / gauge)
                rooms = [
                    (constraint_set.row_slacks(trial) - depth).amin(-1, keepdim=True)
                    for constraint_set, depth in zip(both, depths, strict=True)
                ]
                anchor = torch.where(torch.minimum(*rooms) >= 0, trial, anchor)
            rays.append(self.rays_from(anchor, self._directions_about(anchor - given, samples)))
        return replace(self, rays=tuple(rays))

    def _directions_about(self, towards: Tensor, count: int) -> Tensor:
        """Return directions ``(count, B, d)``, half of them nearly along or across a given one."""
        towards = torch.where(towards.abs().amax(-1, keepdim=True) > 0, towards, 1.0)
        towards = towards / vector_norm(towards, dim=-1, keepdim=True)
        directions = self.directions(count)
        along = directions - (directions * towards).sum(-1, keepdim=True) * towards
        along = along / vector_norm(along, dim=-1, keepdim=True).clamp(min=1e-9)
        lean = 1e-7 ** self.uniform(count, *towards.shape[:1], 1)
        kinds = torch.stack(
            [
                directions,
                towards + lean * along,
                directions,
                lean * along - towards,
                directions,
                along + lean,
            ]
        )
        index = torch.arange(count, device=towards.device)
        return kinds[index % len(kinds), index]


def _rounded(value: Tensor) -> Tensor:
    """Return the nearest numbers of float32, in float64."""
    return value.detach().float().double()


def _bounds_around(sets: ConstraintSet, anchor: Tensor, random: torch.Generator) -> Box:
    """Return bounds some times wider than the set where it is narrowest, not centered."""
    directions = torch.randn(32, *anchor.shape, generator=random, dtype=torch.float64).to(anchor)
    directions = directions / vector_norm(directions, dim=-1, keepdim=True)
    slack = sets.slack(anchor).nan_to_num(1.0, posinf=1.0)
    length = slack.expand(directions.shape[:-1]).clamp(1e-6, 1e6)
    # Six doublings, not doublings until a point is outside: in an open direction there is none.
    for _ in range(6):
        inside = sets.contains(anchor + length.unsqueeze(-1) * directions)
        length = torch.where(inside, 2 * length, length)
    half = length.amin(0).unsqueeze(-1)
    return Box(_rounded(anchor - 3 * half), _rounded(anchor + 5 * half))
