"""Bounds of weighted sums: weighted L1 balls, and limits of positive parts."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import torch
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.geometry.constraint_set import (
    EROSION_IN_EPS,
    Bounds,
    ConstraintSet,
    largest_value,
)
from cnfp_torchrl.geometry.norms import power_of_two
from cnfp_torchrl.geometry.superlevel import KinkedSum


@dataclass(frozen=True, eq=False)
class KinkedSumBound(ConstraintSet):
    r"""The set :math:`\{a : \sum_i \max(\alpha_i a_i, \beta_i a_i) \le bound\}`.

    A family derives :math:`\alpha_i \ge 0 \ge \beta_i` from its weights. The set contains 0.

    Args:
        weights: Weights ``(*batch, d)``, finite; a weight of zero leaves its component free.
        bound: Largest sums ``(*batch,)``, finite, 0 or more.
    """

    weights: Tensor
    bound: Tensor

    event_dims: ClassVar[Mapping[str, int]] = {"weights": 1, "bound": 0}
    finite_fields: ClassVar[frozenset[str]] = frozenset(event_dims)

    @staticmethod
    @abstractmethod
    def slopes(weights: Tensor) -> tuple[Tensor, Tensor]:
        r"""Return :math:`\alpha \ge 0` and :math:`\beta \le 0`, both ``(*batch, d)``."""

    def invalid_fields(self) -> Iterator[tuple[str, Tensor, str]]:
        yield "bound", self.bound < 0, "a finite bound >= 0"

    def contains(self, action: Tensor) -> Tensor:
        sets = self.to(torch.float64)._normalized()
        return sets._total(action.double()) <= sets.bound

    def slack(self, action: Tensor) -> Tensor:
        """Return ``(bound - sum) / |weights|``; infinite where all weights are zero."""
        sets = self._normalized()
        lengths = vector_norm(sets.weights, dim=-1)
        free = lengths == 0
        slack = (sets.bound - sets._total(action)) / lengths.masked_fill(free, 1)
        return slack.masked_fill(free, torch.inf)

    def inflated(self, by: Tensor) -> Self:
        sets = self._normalized()
        bound = sets.bound + by.squeeze(-1) * vector_norm(sets.weights, dim=-1)
        return type(self)(sets.weights, bound, validate_args=False)

    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        r"""Return the gauge about an anchor, in O(d log d).

        Along the ray the sum is convex and piecewise linear in t with at most d kinks. Each piece
        is part of a line :math:`I_j + S_j t` that lies below the sum everywhere, so
        :math:`g = \max(0, \max_j S_j / (bound - I_j))`, where a piece's :math:`bound - I_j` is
        positive because the sum at t = 0 is below the bound.
        """
        sets = self._normalized()
        side = sets._side_at_exit(direction.detach(), anchor.detach())
        room = sets.bound - (side * anchor).sum(-1)
        # Without weights the set is unbounded, and a bound of 0 would leave 0 to divide by.
        room = room.masked_fill((sets.weights == 0).all(-1), 1)
        return ((side * direction).sum(-1) / room).clamp(min=0)

    def bounding_box(self) -> Bounds:
        upper, lower = self.slopes(self.weights)
        bound = self.bound.unsqueeze(-1)
        # A slope of zero leaves its side free, also one of -0 and beside a bound of 0.
        low, high = ((bound / s.abs()).masked_fill(s == 0, torch.inf) for s in (lower, upper))
        return Bounds(-low, high)

    def deepest_within(self, box: Bounds) -> Tensor:
        return torch.zeros_like(box.low).clamp(box.low, box.high)

    def around(self, center: Tensor, radius: Tensor) -> Self:
        # The sum is at most |center|_1 at the center, and grows at most by one each unit.
        weights = torch.full_like(self.weights, self.dim**-0.5)
        return type(self)(weights, center.abs().sum(-1) + radius, validate_args=False)

    def superlevel(self) -> KinkedSum:
        sets = self._normalized()
        return KinkedSum(*self.slopes(sets.weights), sets.bound, vector_norm(sets.weights, dim=-1))

    def _normalized(self) -> Self:
        """Return the same set with weights of about unit size, which do not vanish when squared.

        A bound out of range beside the weights is lowered to it: no action reaches either.
        """
        unit = power_of_two(self.weights.abs().amax(-1))
        bound = (self.bound / unit).clamp(max=largest_value(self.dtype))
        return type(self)(self.weights / unit.unsqueeze(-1), bound, validate_args=False)

    def _total(self, action: Tensor) -> Tensor:
        upper, lower = self.slopes(self.weights)
        return torch.maximum(upper * action, lower * action).sum(-1)

    def _side_at_exit(self, direction: Tensor, anchor: Tensor) -> Tensor:
        """Return the slope of each term where the ray leaves the set, ``(*batch, d)``."""
        anchor, direction, _ = torch.broadcast_tensors(anchor, direction, self.bound.unsqueeze(-1))
        starts_up = (anchor > 0) | ((anchor == 0) & (direction > 0))
        ends_up = torch.where(direction == 0, starts_up, direction > 0)
        upper, lower = self.slopes(self.weights)
        before, after = torch.where(starts_up, upper, lower), torch.where(ends_up, upper, lower)
        kinks = torch.where(starts_up == ends_up, torch.inf, -anchor / direction)
        turn = after - before
        kinks, turn, anchor_, direction_ = torch.broadcast_tensors(kinks, turn, anchor, direction)
        order = kinks.argsort(-1)
        slopes = _running(before * direction, (turn * direction_).gather(-1, order))
        intercepts = _running(before * anchor, (turn * anchor_).gather(-1, order))
        last = (slopes / (self.bound.unsqueeze(-1) - intercepts)).argmax(-1, keepdim=True)
        # By their order, not by comparing kinks: those that are equal up to rounding, as where
        # terms vanish together, would all be passed, whichever of their pieces was chosen.
        return torch.where(order.argsort(-1) < last, after, before)


def _running(terms: Tensor, changes: Tensor) -> Tensor:
    """Return the sum of the terms, and after each change, ``(*batch, d + 1)``."""
    return torch.cat([terms.sum(-1, keepdim=True), changes], -1).cumsum(-1)


@dataclass(frozen=True, eq=False)
class WeightedL1Ball(KinkedSumBound):
    r"""The weighted L1 ball :math:`\{a : \sum_i |weights_i a_i| \le bound\}`.

    With joint velocities as weights and torques as actions it limits the power of all joints.

    Args:
        weights: Weights ``(*batch, d)``, finite; a weight of zero leaves its component free.
        bound: Largest sums ``(*batch,)``, finite, 0 or more.
    """

    @staticmethod
    def slopes(weights: Tensor) -> tuple[Tensor, Tensor]:
        return weights.abs(), -weights.abs()

    def eroded(self, magnitude: Tensor | float = 1.0) -> Self:
        # In shares of the bound, not of the magnitude: terms are no larger than the bound in the
        # set, so rounding errors do not depend on the size of the actions.
        eps = EROSION_IN_EPS * torch.finfo(self.dtype).eps
        sets = self._normalized()
        return type(self)(sets.weights, sets.bound * (1 - 2 * eps), validate_args=False)


@dataclass(frozen=True, eq=False)
class PositivePart(KinkedSumBound):
    r"""The unbounded set :math:`\{a : \sum_i \max(weights_i a_i, 0) \le bound\}`.

    With joint velocities as weights and torques as actions it limits the power that the joints
    draw; power that they return does not count.

    Args:
        weights: Weights ``(*batch, d)``, finite; a weight of zero leaves its component free.
        bound: Largest sums ``(*batch,)``, finite, 0 or more.
    """

    @staticmethod
    def slopes(weights: Tensor) -> tuple[Tensor, Tensor]:
        return weights.clamp(min=0), weights.clamp(max=0)

    def eroded(self, magnitude: Tensor | float = 1.0) -> Self:
        # With the magnitude, because terms that do not count may be as negative as actions allow.
        eps = EROSION_IN_EPS * torch.finfo(self.dtype).eps
        sets = self._normalized()
        size = sets.bound + sets.weights.abs().sum(-1) * magnitude
        return type(self)(sets.weights, sets.bound - eps * size, validate_args=False)
