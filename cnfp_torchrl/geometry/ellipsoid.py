"""Ellipsoids: affine images of the unit ball."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Self

import torch
from torch import Tensor
from torch.linalg import solve_triangular, vector_norm

from cnfp_torchrl.geometry.ball import ball_gauge_about
from cnfp_torchrl.geometry.box import Box
from cnfp_torchrl.geometry.constraint_set import EROSION_IN_EPS, ConstraintSet, Gauge
from cnfp_torchrl.geometry.matrix_norm import spectral_norm_bound
from cnfp_torchrl.geometry.superlevel import Cone


@dataclass(frozen=True, eq=False)
class Ellipsoid(ConstraintSet):
    r"""The ellipsoid :math:`\{m + T x : |x| \le 1\}` with T lower triangular.

    Args:
        center: m, ``(*batch, d)``.
        scale_tril: T, ``(*batch, d, d)``, zero above its positive diagonal.
    """

    center: Tensor
    scale_tril: Tensor

    event_dims: ClassVar[Mapping[str, int]] = {"center": 1, "scale_tril": 2}

    def invalid_fields(self) -> Iterator[tuple[str, Tensor, str]]:
        yield "center", self.center.isinf(), "a finite center"
        yield "scale_tril", self.scale_tril.isinf(), "finite elements"
        yield "scale_tril", self.scale_tril.triu(1) != 0, "zeros above the diagonal"
        diagonal = torch.eye(self.dim, dtype=torch.bool, device=self.scale_tril.device)
        yield "scale_tril", (self.scale_tril <= 0) & diagonal, "a positive diagonal"

    def shape_problem(self) -> str | None:
        rows, columns = self.scale_tril.shape[-2:]
        if rows == columns:
            return None
        return f"expected a square 'scale_tril' (*batch, d, d), given {rows} by {columns}"

    def whiten(self, vector: Tensor) -> Tensor:
        """Return ``T^-1 vector``, the vector in coordinates where the ellipsoid is a unit ball."""
        return _solve(self.scale_tril, vector)

    def contains(self, action: Tensor) -> Tensor:
        white = _solve(self.scale_tril.double(), action.double() - self.center.double())
        return vector_norm(white, dim=-1) <= 1

    def slack(self, action: Tensor) -> Tensor:
        """Return ``(1 - |T^-1 (a - m)|) / n``, n a bound of the norm of ``T^-1``."""
        white = vector_norm(self.whiten(action - self.center), dim=-1)
        return (1 - white) / self._inverse_norm()

    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        return self.gauge_about(anchor)(direction)

    def gauge_about(self, anchor: Tensor) -> Gauge:
        offset = self.whiten(anchor - self.center)
        return partial(self._gauge, ball_gauge_about(offset, torch.ones_like(offset[..., 0])))

    def _gauge(self, of_unit_ball: Gauge, direction: Tensor) -> Tensor:
        return of_unit_ball(self.whiten(direction))

    def bounding_box(self) -> Box:
        half = vector_norm(self.scale_tril, dim=-1)
        return Box(self.center - half, self.center + half, validate_args=False)

    def eroded(self, magnitude: Tensor | float = 1.0) -> Self:
        eps = EROSION_IN_EPS * torch.finfo(self.dtype).eps
        size = vector_norm(self.scale_tril, dim=(-2, -1)) + vector_norm(self.center, dim=-1)
        # An ellipsoid thinner than its rounding error must not turn inside out: what is left of it
        # has no slack to speak of, so that it is dropped like an empty set.
        share = (1 - eps * size * self._inverse_norm()).clamp(min=eps)
        return type(self)(
            self.center, self.scale_tril * share[..., None, None], validate_args=False
        )

    def around(self, center: Tensor, radius: Tensor) -> Self:
        scale_tril = self._identity() * radius[..., None, None]
        return type(self)(center, scale_tril, validate_args=False)

    def superlevel(self) -> Cone:
        inverse = solve_triangular(self.scale_tril, self._identity(), upper=False)
        rate = self._inverse_norm()
        return Cone(inverse, -self.whiten(self.center), torch.ones_like(rate), rate)

    def _identity(self) -> Tensor:
        return torch.eye(self.dim, dtype=self.dtype, device=self.scale_tril.device)

    def _inverse_norm(self) -> Tensor:
        """Return a bound of the spectral norm of ``T^-1``."""
        return spectral_norm_bound(solve_triangular(self.scale_tril, self._identity(), upper=False))


def _solve(scale_tril: Tensor, vector: Tensor) -> Tensor:
    return solve_triangular(scale_tril, vector.unsqueeze(-1), upper=False).squeeze(-1)
