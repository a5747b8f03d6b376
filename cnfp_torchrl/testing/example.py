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
"""Shares of the way from a boundary back to the anchor, at which further anchors are tried."""


class View(NamedTuple):
    """An anchor, and ways from it to the action bounds.

    Args:
        anchor: ``(B, d)``.
        ways: ``(N, B, d)``; the bounds' gauge of each is about 1.
    """

    anchor: Tensor
    ways: Tensor

    def cast(self, dtype: torch.dtype) -> View:
        """Return the same in a dtype."""
        return View(self.anchor.to(dtype), self.ways.to(dtype))

    def at(self, gauge: Tensor) -> Tensor:
        """Return the points ``anchor + way / gauge``, ``(N, B, d)``."""
        return self.anchor + self.ways / gauge.unsqueeze(-1)


@dataclass(frozen=True)
class Example:
    """Sets and anchors, flat and in float64, of numbers that float32 holds too.

    Args:
        sets: of batch shape ``(B,)``.
        bounds: finite action bounds around the anchors, of batch shape ``(B,)``.
        views: one for each anchor, the given one first.
        random: what draws all random numbers.
    """

    sets: ConstraintSet
    bounds: Box
    views: tuple[View, ...]
    random: torch.Generator

    @classmethod
    def of(
        cls, sets: ConstraintSet, anchor: Tensor, bounds: Box | None, samples: int, seed: int
    ) -> Self:
        """Flatten an example whose shapes are known to be right.

        Raises:
            ValueError: when the bounds are not finite or do not hold the anchors.
        """
        batch = torch.broadcast_shapes(sets.batch_shape, anchor.shape[:-1])
        index = torch.arange(batch.numel(), device=anchor.device)
        flat = sets.select(batch, index).with_fields(lambda field, _: _rounded(field))
        anchor = _rounded(anchor.detach().expand(*batch, -1).reshape(-1, anchor.shape[-1]))
        random = torch.Generator().manual_seed(seed)
        if bounds is None:
            around = _bounds_about(flat, anchor, random)
        else:
            bounds = bounds.with_fields(lambda field, _: _rounded(field))
            low, high = (each.expand(*batch, -1) for each in (bounds.low, bounds.high))
            around = Box(low.reshape_as(anchor), high.reshape_as(anchor))
        if not bool((around.slack(anchor) > 0).all() and around.magnitude().isfinite().all()):
            raise ValueError(
                "bounds: expected finite action bounds with the anchors strictly inside, given "
                f"low {around.low.tolist()}, high {around.high.tolist()}"
            )
        example = cls(flat, around, (), random)
        return replace(example, views=(example.view(anchor, example.ways(samples)),))

    @property
    def size(self) -> Tensor:
        """The size of the numbers that actions consist of, ``(B,)``."""
        return self.bounds.magnitude()

    def cast(self, dtype: torch.dtype) -> tuple[Box, ConstraintSet]:
        """Return bounds and sets in a dtype."""
        bounds = self.bounds.to(dtype)
        return bounds, self.sets.to(dtype)

    def normal(self, *shape: int) -> Tensor:
        """Return standard normal numbers in float64."""
        drawn = torch.randn(*shape, generator=self.random, dtype=torch.float64)
        return drawn.to(self.bounds.low.device)

    def uniform(self, *shape: int) -> Tensor:
        """Return numbers between 0 and 1 in float64."""
        drawn = torch.rand(*shape, generator=self.random, dtype=torch.float64)
        return drawn.to(self.bounds.low.device)

    def ways(self, count: int) -> Tensor:
        """Return directions ``(count, B, d)``: Gaussian, on axes, diagonal, and nearly on axes."""
        gauss = self.normal(count, *self.bounds.low.shape)
        largest = gauss.abs() == gauss.abs().amax(-1, keepdim=True)
        axis = torch.where(largest, gauss, 0.0)
        kinds = torch.stack([gauss, axis, gauss.sign(), axis + 1e-6 * gauss, gauss])
        each = torch.arange(count, device=gauss.device)
        return kinds[each % len(kinds), each]

    def view(self, anchor: Tensor, directions: Tensor) -> View:
        """Return the view from an anchor in directions that are not zero."""
        room = self.bounds.gauge(directions, anchor).unsqueeze(-1)
        return View(anchor, _rounded(directions / room))

    def actions(self, count: int) -> Tensor:
        """Return actions ``(count, B, d)`` up to twice as far as the bounds, at all distances."""
        anchor = self.views[0].anchor
        view = self.view(anchor, self.ways(count))
        share = 2 * 1e-4 ** self.uniform(count, len(anchor), 1)
        return anchor + view.ways * share

    def with_anchors_near_the_boundary(self, samples: int) -> Self:
        """Return the example with further anchors, as near as the search for anchors may find any.

        From each some ways lead straight towards the boundary, away from it and along it, where a
        gauge that subtracts large numbers is worst.
        """
        given = self.views[0].anchor
        # In float32, where an anchor keeps the larger depth.
        depths = row_depths([each.to(torch.float32) for each in (self.bounds, self.sets)])
        both = (self.bounds, self.sets)
        views = [self.views[0]]
        for way in self.ways(4):
            gauge = torch.maximum(*(each.gauge(way, given) for each in both)).unsqueeze(-1)
            anchor = given
            for depth in _DEPTHS:
                trial = _rounded(given + way * (1 - depth) / gauge)
                rooms = [
                    (each.row_slacks(trial) - depth).amin(-1, keepdim=True)
                    for each, depth in zip(both, depths, strict=True)
                ]
                anchor = torch.where(torch.minimum(*rooms) >= 0, trial, anchor)
            views.append(self.view(anchor, self._ways_about(anchor - given, samples)))
        return replace(self, views=tuple(views))

    def _ways_about(self, towards: Tensor, count: int) -> Tensor:
        """Return directions of which half are towards, away or along, more or less."""
        towards = torch.where(towards.abs().amax(-1, keepdim=True) > 0, towards, 1.0)
        towards = towards / vector_norm(towards, dim=-1, keepdim=True)
        ways = self.ways(count)
        along = ways - (ways * towards).sum(-1, keepdim=True) * towards
        along = along / vector_norm(along, dim=-1, keepdim=True).clamp(min=1e-9)
        lean = 1e-7 ** self.uniform(count, *towards.shape[:1], 1)
        kinds = torch.stack(
            [ways, towards + lean * along, ways, lean * along - towards, ways, along + lean]
        )
        each = torch.arange(count, device=towards.device)
        return kinds[each % len(kinds), each]


def _rounded(value: Tensor) -> Tensor:
    return value.detach().float().double()


def _bounds_about(sets: ConstraintSet, anchor: Tensor, random: torch.Generator) -> Box:
    """Return bounds some times wider than the set is where it is narrow, not centered."""
    ways = torch.randn(32, *anchor.shape, generator=random, dtype=torch.float64).to(anchor)
    ways = ways / vector_norm(ways, dim=-1, keepdim=True)
    slack = sets.slack(anchor).nan_to_num(1.0, posinf=1.0)
    length = slack.expand(ways.shape[:-1]).clamp(1e-6, 1e6)
    # Not for ever: about a set that is open in most directions, bounds are a matter of taste.
    for _ in range(6):
        inside = sets.contains(anchor + length.unsqueeze(-1) * ways)
        length = torch.where(inside, 2 * length, length)
    half = length.amin(0).unsqueeze(-1)
    return Box(_rounded(anchor - 3 * half), _rounded(anchor + 5 * half))
