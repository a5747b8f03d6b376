"""Balls: actions within a distance of a point."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import torch
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.geometry.box import Box
from cnfp_torchrl.geometry.constraint_set import EROSION_IN_EPS, ConstraintSet
from cnfp_torchrl.geometry.superlevel import Cone


def ball_gauge(direction: Tensor, offset: Tensor, radius: Tensor) -> Tensor:
    r"""Return the gauge of a ball of the given radius about a point at an offset from its centre.

    With :math:`k = (r - |w|)(r + |w|)`, :math:`b = v \cdot w`, :math:`q = |v|^2`:
    :math:`g = (b + \sqrt{b^2 + qk})/k`, rewritten for :math:`b < 0` as
    :math:`q / (\sqrt{b^2 + qk} - b)`, so that neither form cancels.

    Args:
        direction: v, ``(*batch, d)``, not zero.
        offset: w, the point minus the ball's centre, ``(*batch, d)``, shorter than the radius.
        radius: r, ``(*batch,)``.
    """
    distance = vector_norm(offset, dim=-1)
    k = (radius - distance) * (radius + distance)
    b = (direction * offset).sum(-1)
    q = direction.square().sum(-1)
    root = torch.sqrt(b.square() + q * k)
    outwards = b >= 0
    return torch.where(outwards, b + root, q) / torch.where(outwards, k, root - b)


@dataclass(frozen=True, eq=False)
class Ball(ConstraintSet):
    r"""The ball :math:`\{a : |a - center| \le radius\}`.

    Args:
        center: ``(*batch, d)``.
        radius: ``(*batch,)``, positive and finite.
    """

    center: Tensor
    radius: Tensor

    event_dims: ClassVar[Mapping[str, int]] = {"center": 1, "radius": 0}

    def violations(self) -> Iterator[tuple[str, Tensor, str]]:
        yield "radius", (self.radius <= 0) | self.radius.isinf(), "a finite radius > 0"
        yield "center", self.center.isinf(), "a finite center"

    def contains(self, action: Tensor) -> Tensor:
        offset = action.double() - self.center.double()
        return vector_norm(offset, dim=-1) <= self.radius.double()

    def slack(self, action: Tensor) -> Tensor:
        return self.radius - vector_norm(action - self.center, dim=-1)

    def gauge(self, direction: Tensor, centre: Tensor) -> Tensor:
        return ball_gauge(direction, centre - self.center, self.radius)

    def bounding_box(self) -> Box:
        radius = self.radius.unsqueeze(-1)
        return Box(self.center - radius, self.center + radius, validate_args=False)

    def eroded(self, magnitude: Tensor | float = 1.0) -> Self:
        eps = EROSION_IN_EPS * torch.finfo(self.dtype).eps
        size = self.radius + vector_norm(self.center, dim=-1)
        return type(self)(self.center, self.radius - eps * size, validate_args=False)

    def unit_about(self, centre: Tensor) -> Self:
        return type(self)(centre, torch.ones_like(centre[..., 0]), validate_args=False)

    def superlevel(self) -> Cone:
        identity = torch.eye(self.dim, dtype=self.dtype, device=self.center.device)
        return Cone(identity, -self.center, self.radius, torch.ones_like(self.radius))

    def unless_dropped(self, active: Tensor, centre: Tensor) -> Self:
        # The radius alone, because torch.where is slow where the mask broadcasts.
        around = vector_norm(centre - self.center, dim=-1) + 1
        radius = torch.where(active, self.radius, around)
        return type(self)(self.center, radius, validate_args=False)

    def inner_ball(self, radius: float) -> Self:
        r"""Return the ball of at most the given radius inside this one that is nearest to 0.

        Its centre is :math:`m \max(0, 1 - (r - \rho)/|m|)` with :math:`\rho = \min(r, radius)`: 0
        when this ball has room for it there, and on the way to this ball's centre m otherwise.
        """
        inner = self.radius.clamp(max=radius)
        distance = vector_norm(self.center, dim=-1)
        room = self.radius - inner
        share = torch.where(room >= distance, torch.zeros_like(room), 1 - room / distance)
        return type(self)(self.center * share.unsqueeze(-1), inner, validate_args=False)
