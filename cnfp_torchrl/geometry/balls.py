"""Balls and their affine relatives: ellipsoids, and balls in a task space."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Self

import torch
from torch import Tensor
from torch.linalg import solve_triangular, vector_norm

from cnfp_torchrl.geometry.constraint_set import (
    EROSION_IN_EPS,
    Bounds,
    ConstraintSet,
    Gauge,
    largest_value,
)
from cnfp_torchrl.geometry.norms import component_sum, length, power_of_two, spectral_norm_bound
from cnfp_torchrl.geometry.superlevel import Cone

MOST_SKEWED = 1e15
"""The largest norm of ``T^-1`` of a valid ellipsoid, in units of T's smallest diagonal element."""


@dataclass(frozen=True, eq=False)
class Ball(ConstraintSet):
    r"""The ball :math:`\{a : |a - center| \le radius\}`.

    Args:
        center: Centers ``(*batch, d)``, finite.
        radius: Radii ``(*batch,)``, finite, 0 or more; a ball of radius 0 is a point.
    """

    center: Tensor
    radius: Tensor

    event_dims: ClassVar[Mapping[str, int]] = {"center": 1, "radius": 0}
    finite_fields: ClassVar[frozenset[str]] = frozenset(event_dims)

    def invalid_fields(self) -> Iterator[tuple[str, Tensor, str]]:
        yield "radius", self.radius < 0, "a finite radius >= 0"

    def whiten(self, vector: Tensor) -> Tensor:
        """Return the vector in units of the radius, in which the ball is a unit ball."""
        return vector / self.radius.unsqueeze(-1)

    def contains(self, action: Tensor) -> Tensor:
        offset = action.double() - self.center.double()
        return length(offset) <= self.radius.double()

    def slack(self, action: Tensor) -> Tensor:
        return self.radius - length(action - self.center)

    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        return self.gauge_about(anchor)(direction)

    def gauge_about(self, anchor: Tensor) -> Gauge:
        return ball_gauge_about(anchor - self.center, self.radius)

    def bounding_box(self) -> Bounds:
        radius = self.radius.unsqueeze(-1)
        return Bounds(self.center - radius, self.center + radius)

    def deepest_within(self, box: Bounds) -> Tensor:
        return torch.clamp(self.center, box.low, box.high)

    def inflated(self, by: Tensor) -> Self:
        return type(self)(self.center, self.radius + by.squeeze(-1), validate_args=False)

    def rounding(self, magnitude: Tensor | float = 1.0) -> Tensor:
        return (EROSION_IN_EPS * torch.finfo(self.dtype).eps * self._size()).unsqueeze(-1)

    def eroded(self, magnitude: Tensor | float = 1.0) -> Self:
        eps = EROSION_IN_EPS * torch.finfo(self.dtype).eps
        radius = torch.sub(self.radius, self._size(), alpha=eps)
        return type(self)(self.center, radius, validate_args=False)

    def _size(self) -> Tensor:
        """Return the size of the numbers whose rounding errors add up, ``(*batch,)``."""
        # Not the center's length, which needs a unit that its squares are in range in; and not
        # `torch.linalg.vector_norm`, whose sums take ten times as long.
        return self.radius + component_sum(self.center.abs())

    def around(self, center: Tensor, radius: Tensor) -> Self:
        return type(self)(center, radius.expand(center.shape[:-1]), validate_args=False)

    def superlevel(self) -> Cone:
        identity = torch.eye(self.dim, dtype=self.dtype, device=self.center.device)
        return Cone(identity, -self.center, self.radius, torch.ones_like(self.radius))

    def unless_dropped(self, active: Tensor, center: Tensor, radius: Tensor) -> Self:
        # The radius alone is replaced, not the center, because torch.where is slow where the mask
        # broadcasts. The distance of a far center has a rounding error that may exceed what is
        # added to it, so that is added, too.
        distance = length(center - self.center)
        eps = EROSION_IN_EPS * torch.finfo(self.dtype).eps
        beyond = torch.add(distance, distance, alpha=eps) + radius
        return type(self)(
            self.center, torch.where(active, self.radius, beyond), validate_args=False
        )

    def inner_ball(self, radius: float) -> Self:
        r"""Return the ball of at most the given radius inside this one that is nearest to 0.

        Its center is :math:`m \max(0, 1 - (r - \rho)/|m|)` with :math:`\rho = \min(r, radius)`,
        m and r being center and radius of this ball: 0 if there is room, else between 0 and m.
        """
        inner = self.radius.clamp(max=radius)
        distance = length(self.center)
        room = self.radius - inner
        share = torch.where(room >= distance, torch.zeros_like(room), 1 - room / distance)
        return type(self)(self.center * share.unsqueeze(-1), inner, validate_args=False)


@dataclass(frozen=True, eq=False)
class Ellipsoid(ConstraintSet):
    r"""The ellipsoid :math:`\{m + T x : |x| \le 1\}` with T lower triangular.

    Args:
        center: Centers m, ``(*batch, d)``, finite.
        scale_tril: Matrices T, ``(*batch, d, d)``, zero above their positive diagonals.
    """

    center: Tensor
    scale_tril: Tensor

    event_dims: ClassVar[Mapping[str, int]] = {"center": 1, "scale_tril": 2}
    finite_fields: ClassVar[frozenset[str]] = frozenset(event_dims)

    def invalid_fields(self) -> Iterator[tuple[str, Tensor, str]]:
        yield "scale_tril", self.scale_tril.triu(1) != 0, "zeros above the diagonal"
        diagonal = torch.eye(self.dim, dtype=torch.bool, device=self.scale_tril.device)
        yield "scale_tril", (self.scale_tril <= 0) & diagonal, "a positive diagonal"
        thin = ~(spectral_norm_bound(self._inverse()) < MOST_SKEWED)
        expected = f"an inverse below {MOST_SKEWED:g} in units of the smallest diagonal element"
        yield "scale_tril", thin, expected

    def shape_problem(self) -> str | None:
        rows, columns = self.scale_tril.shape[-2:]
        if rows == columns:
            return None
        return f"expected a square 'scale_tril' (*batch, d, d), given {rows} by {columns}"

    def whiten(self, vector: Tensor) -> Tensor:
        """Return ``T^-1 vector``, in coordinates in which the ellipsoid is a unit ball."""
        return _solve(self.scale_tril, vector)

    def slack(self, action: Tensor) -> Tensor:
        """Return ``(1 - |T^-1 (a - m)|) / n``, n a bound of the norm of ``T^-1``."""
        unit, scale_tril = self._in_units()
        offset = action - self.center
        size = power_of_two(offset.abs().amax(-1))
        white = size * length(_solve(scale_tril, offset / size.unsqueeze(-1)))
        return (unit - white) / spectral_norm_bound(self._inverse())

    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        return self.gauge_about(anchor)(direction)

    def gauge_about(self, anchor: Tensor) -> Gauge:
        unit, scale_tril = self._in_units()
        of_ball = ball_gauge_about(_solve(scale_tril, anchor - self.center), unit)
        # No closure: a flow's gauges are pickled with it.
        return partial(_whitened_gauge, scale_tril, of_ball)

    def bounding_box(self) -> Bounds:
        half = length(self.scale_tril)
        return Bounds(self.center - half, self.center + half)

    def inflated(self, by: Tensor) -> Self:
        # Not T plus a share of T, which may be out of range beside a large amount. What `eroded`
        # takes from the longer axes is added, because `rounding` counts the shorter ones alone.
        unit, scale_tril = self._in_units()
        norm = spectral_norm_bound(self._inverse())
        eps = 2 * EROSION_IN_EPS * torch.finfo(self.dtype).eps
        more = 1 + eps * norm * length(scale_tril.flatten(-2))
        longer = unit + by.squeeze(-1) * norm * more
        return type(self)(self.center, scale_tril * longer[..., None, None], validate_args=False)

    def rounding(self, magnitude: Tensor | float = 1.0) -> Tensor:
        return (EROSION_IN_EPS * torch.finfo(self.dtype).eps * self._size()).unsqueeze(-1)

    def eroded(self, magnitude: Tensor | float = 1.0) -> Self:
        eps = EROSION_IN_EPS * torch.finfo(self.dtype).eps
        # Clamped, so that an ellipsoid thinner than its rounding error does not turn inside out;
        # a region keeps such a set only after it was inflated by more than that.
        unit, _ = self._in_units()
        relative = self._size() / unit
        share = (1 - eps * relative * spectral_norm_bound(self._inverse())).clamp(min=eps)
        return type(self)(
            self.center, self.scale_tril * share[..., None, None], validate_args=False
        )

    def around(self, center: Tensor, radius: Tensor) -> Self:
        scale_tril = self._identity() * radius[..., None, None]
        return type(self)(center, scale_tril, validate_args=False)

    def superlevel(self) -> Cone:
        unit, scale_tril = self._in_units()
        inverse = self._inverse()
        return Cone(inverse, -_solve(scale_tril, self.center), unit, spectral_norm_bound(inverse))

    def _size(self) -> Tensor:
        """Return the size of the numbers whose rounding errors add up, ``(*batch,)``."""
        return length(self.scale_tril.flatten(-2)) + length(self.center)

    def _identity(self) -> Tensor:
        return torch.eye(self.dim, dtype=self.dtype, device=self.scale_tril.device)

    def _in_units(self) -> tuple[Tensor, Tensor]:
        """Return about the shortest half-axis u, as a power of two, and ``T / u``.

        In such units an inverse, and what it is applied to, have sizes that can be squared.
        """
        unit = power_of_two(self.scale_tril.diagonal(dim1=-2, dim2=-1).amin(-1))
        return unit, self.scale_tril / unit[..., None, None]

    def _inverse(self) -> Tensor:
        """Return ``u T^-1``, with the u of `_in_units`."""
        return solve_triangular(self._in_units()[1], self._identity(), upper=False)


def _whitened_gauge(scale_tril: Tensor, of_ball: Gauge, direction: Tensor) -> Tensor:
    return of_ball(_solve(scale_tril, direction))


def _solve(scale_tril: Tensor, vector: Tensor) -> Tensor:
    return solve_triangular(scale_tril, vector.unsqueeze(-1), upper=False).squeeze(-1)


@dataclass(frozen=True, eq=False)
class TaskSpaceBall(ConstraintSet):
    r"""The set :math:`\{a : |J a + b| \le radius\}`, convex; unbounded if J has a null space.

    With J a manipulator's Jacobian and a its joint velocities, it limits the end effector's speed
    (b = 0) or the distance to a wanted velocity -b. With some rows of the identity as J, it is a
    ball in some of the components. A J of zero lets every action pass if :math:`|b| \le radius`,
    else none.

    Args:
        jacobian: Matrices J, ``(*batch, m, d)``, finite.
        offset: Vectors b, ``(*batch, m)``, finite.
        radius: Radii ``(*batch,)``, finite, 0 or more.
    """

    jacobian: Tensor
    offset: Tensor
    radius: Tensor

    event_dims: ClassVar[Mapping[str, int]] = {"jacobian": 2, "offset": 1, "radius": 0}
    finite_fields: ClassVar[frozenset[str]] = frozenset(event_dims)

    def invalid_fields(self) -> Iterator[tuple[str, Tensor, str]]:
        far = self.offset.abs() / largest_value(self.dtype) > self._norm().unsqueeze(-1)
        expected = f"an offset up to {largest_value(self.dtype):g} times the norm of the jacobian"
        yield "offset", far, expected
        yield "radius", self.radius < 0, "a finite radius >= 0"

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
        return length(image) <= self.radius.double()

    def slack(self, action: Tensor) -> Tensor:
        """Return ``(radius - |J a + b|) / n``, n a bound of the norm of J, or 1 where J is zero."""
        distance = length(_image(self.jacobian, action) + self.offset)
        return (self.radius - distance) / self._norm()

    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        return self.gauge_about(anchor)(direction)

    def gauge_about(self, anchor: Tensor) -> Gauge:
        # In units of J's norm, not of one: a small J alone must not make images vanish.
        norm = self._norm()
        offset = _image(self.jacobian, anchor) + self.offset
        jacobian = self.jacobian / norm[..., None, None]
        return partial(_image_gauge, jacobian, ball_gauge_about(offset, self.radius, norm))

    def eroded(self, magnitude: Tensor | float = 1.0) -> Self:
        eps = EROSION_IN_EPS * torch.finfo(self.dtype).eps
        radius = torch.sub(self.radius, self._size(magnitude), alpha=eps)
        return type(self)(self.jacobian, self.offset, radius, validate_args=False)

    def rounding(self, magnitude: Tensor | float = 1.0) -> Tensor:
        eps = EROSION_IN_EPS * torch.finfo(self.dtype).eps
        return (eps * self._size(magnitude) / self._norm()).unsqueeze(-1)

    def inflated(self, by: Tensor) -> Self:
        radius = self.radius + by.squeeze(-1) * self._norm()
        return type(self)(self.jacobian, self.offset, radius, validate_args=False)

    def _size(self, magnitude: Tensor | float) -> Tensor:
        """Return the size of the numbers whose rounding errors add up, ``(*batch,)``."""
        largest = torch.as_tensor(magnitude, dtype=self.dtype, device=self.radius.device)
        terms = self.jacobian.abs().sum(-1) * largest.unsqueeze(-1) + self.offset.abs()
        return self.radius + length(terms)

    def around(self, center: Tensor, radius: Tensor) -> Self:
        offset = -_image(self.jacobian, center)
        return type(self)(self.jacobian, offset, self._norm() * radius, validate_args=False)

    def superlevel(self) -> Cone:
        return Cone(self.jacobian, self.offset, self.radius, self._norm())

    def _norm(self) -> Tensor:
        bound = spectral_norm_bound(self.jacobian)
        return bound.masked_fill(bound == 0, 1)


def _image_gauge(jacobian: Tensor, of_ball: Gauge, direction: Tensor) -> Tensor:
    unit = power_of_two(direction.abs().amax(-1))
    image = _image(jacobian, direction / unit.unsqueeze(-1))
    # The set is unbounded in J's null space. An image that vanishes when squared, beside J's norm
    # and the direction's length, is replaced before the gauge, not only after it, so that no
    # gradient becomes NaN.
    vanishes = image.abs().amax(-1) < torch.finfo(image.dtype).tiny ** 0.5
    return unit * of_ball(image + vanishes.unsqueeze(-1)).masked_fill(vanishes, 0)


def _image(jacobian: Tensor, vector: Tensor) -> Tensor:
    return (jacobian * vector.unsqueeze(-2)).sum(-1)


def ball_gauge_about(offset: Tensor, radius: Tensor, unit: Tensor | None = None) -> Gauge:
    r"""Return the gauge of a ball about a point at an offset from the ball's center.

    With :math:`k = (r - |w|)(r + |w|)`, :math:`\beta = v \cdot w/k` and :math:`q = |v|^2/k`:
    :math:`g = \beta + \sqrt{\beta^2 + q}`, which cancels for :math:`\beta < 0`. With
    :math:`p = 2\max(\beta, 0)` and :math:`h = \sqrt{\beta^2 + q} + |\beta|`, written
    :math:`\sqrt{\beta^2 + q} + p - \beta` to have the right gradient at 0, :math:`g = p + q/h`
    never does. Computed in units of the radius, whose square may be out of range.

    Args:
        offset: Points minus the ball's center, w, ``(*batch, d)``, shorter than the radius.
        radius: Radii r, ``(*batch,)``.
        unit: The length in which directions are given, ``(*batch,)``; None means 1.
    """
    offset = offset / radius.unsqueeze(-1)
    distance = vector_norm(offset, dim=-1)
    inverse = ((1 - distance) * (1 + distance)).reciprocal()
    scale = radius.reciprocal() if unit is None else unit / radius
    return partial(_ball_gauge, offset * inverse.unsqueeze(-1), inverse, scale)


def _ball_gauge(scaled_offset: Tensor, inverse: Tensor, scale: Tensor, direction: Tensor) -> Tensor:
    beta = component_sum(direction * scaled_offset)
    q = component_sum(direction * direction) * inverse
    ahead = beta.relu()
    h = torch.add(torch.addcmul(q, beta, beta).sqrt(), ahead, alpha=2) - beta
    return torch.add(q / h, ahead, alpha=2) * scale
