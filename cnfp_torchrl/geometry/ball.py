"""Balls: actions within a distance of a point."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Self

import torch
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.geometry.box import Box
from cnfp_torchrl.geometry.constraint_set import EROSION_IN_EPS, ConstraintSet, Gauge
from cnfp_torchrl.geometry.superlevel import Cone


def ball_gauge_about(offset: Tensor, radius: Tensor) -> Gauge:
    r"""Return the gauge of a ball about a point at an offset from the ball's center.

    With :math:`k = (r - |w|)(r + |w|)`, :math:`\beta = v \cdot w/k` and :math:`q = |v|^2/k`:
    :math:`g = \beta + \sqrt{\beta^2 + q}`, which cancels for :math:`\beta < 0`. With
    :math:`p = 2\max(\beta, 0)` and :math:`h = \sqrt{\beta^2 + q} + |\beta|`, written
    :math:`\sqrt{\beta^2 + q} + p - \beta` to have the right gradient at 0, :math:`g = p + q/h`
    never does.

    Args:
        offset: w, the point minus the ball's center, ``(*batch, d)``, shorter than the radius.
        radius: r, ``(*batch,)``.
    """
    distance = vector_norm(offset, dim=-1)
    inverse = ((radius - distance) * (radius + distance)).reciprocal()
    return partial(_gauge, offset * inverse.unsqueeze(-1), inverse)


def _gauge(scaled_offset: Tensor, inverse: Tensor, direction: Tensor) -> Tensor:
    beta = (direction * scaled_offset).sum(-1)
    q = direction.square().sum(-1) * inverse
    ahead = beta.relu()
    h = torch.add(torch.addcmul(q, beta, beta).sqrt(), ahead, alpha=2) - beta
    return torch.add(q / h, ahead, alpha=2)


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

    def invalid_fields(self) -> Iterator[tuple[str, Tensor, str]]:
        yield "radius", (self.radius <= 0) | self.radius.isinf(), "a finite radius > 0"
        yield "center", self.center.isinf(), "a finite center"

    def contains(self, action: Tensor) -> Tensor:
        offset = action.double() - self.center.double()
        return vector_norm(offset, dim=-1) <= self.radius.double()

    def slack(self, action: Tensor) -> Tensor:
        return self.radius - vector_norm(action - self.center, dim=-1)

    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        return self.gauge_about(anchor)(direction)

    def gauge_about(self, anchor: Tensor) -> Gauge:
        return ball_gauge_about(anchor - self.center, self.radius)

    def bounding_box(self) -> Box:
        radius = self.radius.unsqueeze(-1)
        return Box(self.center - radius, self.center + radius, validate_args=False)

    def eroded(self, magnitude: Tensor | float = 1.0) -> Self:
        eps = EROSION_IN_EPS * torch.finfo(self.dtype).eps
        size = self.radius + vector_norm(self.center, dim=-1)
        return type(self)(self.center, torch.sub(self.radius, size, alpha=eps), validate_args=False)

    def around(self, center: Tensor, radius: Tensor) -> Self:
        return type(self)(center, radius.expand(center.shape[:-1]), validate_args=False)

    def superlevel(self) -> Cone:
        identity = torch.eye(self.dim, dtype=self.dtype, device=self.center.device)
        return Cone(identity, -self.center, self.radius, torch.ones_like(self.radius))

    def unless_dropped(self, active: Tensor, center: Tensor, radius: Tensor) -> Self:
        # The radius alone, because torch.where is slow where the mask broadcasts. A far center's
        # distance is known up to rounding error, which may be larger than what is to be added.
        distance = vector_norm(center - self.center, dim=-1)
        eps = EROSION_IN_EPS * torch.finfo(self.dtype).eps
        beyond = torch.add(distance, distance, alpha=eps) + radius
        return type(self)(
            self.center, torch.where(active, self.radius, beyond), validate_args=False
        )

    def inner_ball(self, radius: float) -> Self:
        r"""Return the ball of at most the given radius inside this one that is nearest to 0.

        Its anchor is :math:`m \max(0, 1 - (r - \rho)/|m|)` with :math:`\rho = \min(r, radius)`: 0
        when this ball has room for it there, and on the way to this ball's center m otherwise.
        """
        inner = self.radius.clamp(max=radius)
        distance = vector_norm(self.center, dim=-1)
        room = self.radius - inner
        share = torch.where(room >= distance, torch.zeros_like(room), 1 - room / distance)
        return type(self)(self.center * share.unsqueeze(-1), inner, validate_args=False)
