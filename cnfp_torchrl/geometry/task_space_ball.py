"""Task-space balls: actions with an image, under an affine map, within a distance of 0."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Self

import torch
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.geometry.ball import ball_gauge_about
from cnfp_torchrl.geometry.constraint_set import EROSION_IN_EPS, ConstraintSet, Gauge
from cnfp_torchrl.geometry.matrix_norm import spectral_norm_bound
from cnfp_torchrl.geometry.superlevel import Cone


@dataclass(frozen=True, eq=False)
class TaskSpaceBall(ConstraintSet):
    r"""The set :math:`\{a : |J a + b| \le radius\}`, convex; unbounded if J has a null space.

    With J a manipulator's Jacobian and a its joint velocities: a limit of the end effector's speed
    (b = 0), or of the distance to a wanted velocity -b. With J some rows of the identity: a ball in
    some of the components. Where J is zero every action passes if b is short enough, else none.

    Args:
        jacobian: J, ``(*batch, m, d)``, finite.
        offset: b, ``(*batch, m)``, finite.
        radius: ``(*batch,)``, positive and finite.
    """

    jacobian: Tensor
    offset: Tensor
    radius: Tensor

    event_dims: ClassVar[Mapping[str, int]] = {"jacobian": 2, "offset": 1, "radius": 0}

    def invalid_fields(self) -> Iterator[tuple[str, Tensor, str]]:
        yield "jacobian", self.jacobian.isinf(), "finite elements"
        yield "offset", self.offset.isinf(), "a finite offset"
        yield "radius", (self.radius <= 0) | self.radius.isinf(), "a finite radius > 0"

    def shape_problem(self) -> str | None:
        rows, components = self.jacobian.shape[-2], self.offset.shape[-1]
        if rows == components and rows > 0:
            return None
        return (
            "expected as many components of the offset as rows of the jacobian, at least 1, given "
            f"{components} and {rows}"
        )

    @classmethod
    def fields_of_other_width(cls) -> frozenset[str]:
        return frozenset({"offset"})

    def contains(self, action: Tensor) -> Tensor:
        image = _image(self.jacobian.double(), action.double()) + self.offset.double()
        return vector_norm(image, dim=-1) <= self.radius.double()

    def slack(self, action: Tensor) -> Tensor:
        """Return ``(radius - |J a + b|) / n``, n a bound of the norm of J, or 1 where J is zero."""
        distance = vector_norm(_image(self.jacobian, action) + self.offset, dim=-1)
        return (self.radius - distance) / self._norm()

    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        return self.gauge_about(anchor)(direction)

    def gauge_about(self, anchor: Tensor) -> Gauge:
        # In units of J's norm: what vanishes does so beside it, not beside one.
        norm = self._norm()
        offset = (_image(self.jacobian, anchor) + self.offset) / norm.unsqueeze(-1)
        jacobian = self.jacobian / norm[..., None, None]
        return partial(_gauge, jacobian, ball_gauge_about(offset, self.radius / norm))

    def eroded(self, magnitude: Tensor | float = 1.0) -> Self:
        eps = EROSION_IN_EPS * torch.finfo(self.dtype).eps
        largest = torch.as_tensor(magnitude, dtype=self.dtype, device=self.radius.device)
        terms = self.jacobian.abs().sum(-1) * largest.unsqueeze(-1) + self.offset.abs()
        size = self.radius + vector_norm(terms, dim=-1)
        radius = torch.sub(self.radius, size, alpha=eps)
        return type(self)(self.jacobian, self.offset, radius, validate_args=False)

    def around(self, center: Tensor, radius: Tensor) -> Self:
        offset = -_image(self.jacobian, center)
        return type(self)(self.jacobian, offset, self._norm() * radius, validate_args=False)

    def superlevel(self) -> Cone:
        return Cone(self.jacobian, self.offset, self.radius, self._norm())

    def _norm(self) -> Tensor:
        bound = spectral_norm_bound(self.jacobian)
        return bound.masked_fill(bound == 0, 1)


def _gauge(jacobian: Tensor, of_ball: Gauge, direction: Tensor) -> Tensor:
    image = _image(jacobian, direction)
    # In J's null space the set has no end. A direction whose image vanishes when squared is given
    # another one there, so that nothing becomes NaN.
    vanishes = image.abs().amax(-1) < torch.finfo(image.dtype).tiny ** 0.5
    return of_ball(image + vanishes.unsqueeze(-1)).masked_fill(vanishes, 0)


def _image(jacobian: Tensor, vector: Tensor) -> Tensor:
    return (jacobian * vector.unsqueeze(-2)).sum(-1)
