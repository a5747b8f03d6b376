"""The recession of actions along a way out that all half-spaces have in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.linalg import vector_norm
from torch.nn.functional import softplus

from cnfp_torchrl.bijectors.bijector import Bijector, Stages, log_det_zero, stacked
from cnfp_torchrl.bijectors.soft_retraction import SHARPNESS, SoftContraction, require_sharpness
from cnfp_torchrl.geometry import (
    EROSION_IN_EPS,
    Box,
    GeometryError,
    HalfSpaces,
    Region,
    broadcast_shape,
    require_action_bounds,
)

LEAST_MARGIN = 1e-2
"""The least sine of the angle between a way out and each row's boundary."""

_STEPS, _CENTERING, _SHARE = 16, 0.05, 0.95
"""Steps of the search for a way out among more than two rows: their number, the share of the
products of weights and multipliers that each aims at, and of the way to the first that vanishes."""

_RIDGE = 1e-13
"""What is added to the squares of rows in that search, in float64."""

_LARGEST_SOFT = 50.0
"""Beyond it softplus is the identity, in both dtypes."""


class Recession(Bijector):
    r"""Move actions along a common way out of all half-spaces, as far as they need to.

    Let the rows be :math:`A_k a \le b_k`, and r a unit vector with :math:`A_k r < 0` for all k,
    such as each barrier of a vehicle that can brake has. With the scale s, in action units,

    .. math:: need = \max_k \frac{A_k f - b_k}{-A_k r}, \quad
        a = f + r\, s\, \mathrm{softplus}(need/s), \quad \log|\det| = -\mathrm{softplus}(need/s),

    a bijection of R^d onto the interior of the intersection, that needs neither an anchor nor
    bounds and has slope 1 where actions are safe. Rows are eroded by the rounding error of each
    sample's own numbers, so that actions of any size satisfy all rows with zero tolerance.

    The slope vanishes like :math:`e^{-need/s}` beyond the rows, so that the inverse is right to
    rounding for actions whose slack in all rows is some hundred rounding errors, and may be
    infinite or NaN closer to a row (`contains` is false). What it finds becomes the same action
    again, up to some d + 8 rounding errors of the wished action times :math:`1 + 1/\rho`, where
    :math:`\rho = \min_k -A_k r` for rows of length 1.

    A region with an anchor may have finite bounds and further sets: the recession comes first, then
    a soft retraction along rays (`SoftRetraction`) of their intersection onto that with the rest.
    Where its rows have no way out in common, because their intersection is bounded or almost so,
    the soft retraction alone does it all. A region without an anchor, of half-spaces alone, is
    refused there, or without checks its actions are NaN.

    Args:
        region: Regions of batch shape ``(*batch,)``. Without an anchor, all sets but the bounds
            must be half-spaces, and the bounds infinite.
        way_out: Vectors r of any length, ``(*batch, d)``; None takes the one with the largest
            margin to all rows, minus the point of least length in the hull of their unit normals.
        scale: The scale s of the softness, in action units; with ``of_latents`` in units of
            latents.
        sharpness: The sharpness of the soft retraction.
        of_latents: Whether arguments are in units of the bounds, from -1 to 1, as those of a
            Gaussian policy are, and not in action units.
        validate_args: Whether to check bounds and ways out, which reads them on the host.

    Raises:
        ValueError: when scale or sharpness are out of range.
        GeometryError: when a region without an anchor has other sets, finite bounds, or rows
            without a common way out.
    """

    def __init__(
        self,
        region: Region,
        way_out: Tensor | None = None,
        *,
        scale: float = 1.0,
        sharpness: float = SHARPNESS,
        of_latents: bool = False,
        validate_args: bool = True,
    ) -> None:
        super().__init__()
        self._scale, self._sharpness = require_scale(scale), require_sharpness(sharpness)
        self._way_out, self._is_alone = way_out, not region.has_anchor
        if self._is_alone:
            self._refuse_other_sets(region)
        else:
            region = region.with_finite_bounds()
        if validate_args:
            self._refuse_bounds(region.bounds)
        self._given, self._half_width, self._middle = region, None, None
        if of_latents:
            low, high = region.bounds.low, region.bounds.high
            bounded = low.isfinite() & high.isfinite()
            self._half_width = torch.where(bounded, (high - low) / 2, 1.0)
            self._middle = torch.where(bounded, (high + low) / 2, 0.0)
        if not self._is_alone:
            self.region = region.eroded()
        self._rows = self._rows_of(len(region.sets))
        self._rest = self._rest_of(len(region.sets), self._rows)
        if validate_args and self._is_alone:
            self._refuse_no_way_out()

    @property
    def shape(self) -> torch.Size:
        return self._given.shape

    def forward_and_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        if self._half_width is None:
            return self._forward(latent, self._rows, self._rest)
        wished, log_det = self._in_action_units(latent)
        action, change = self._forward(wished, self._rows, self._rest)
        return action, log_det + change

    def forward_and_reference_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        wished, log_det = self._in_action_units(latent)
        _, change = self._forward(wished, None, self._rest_of(1, None))
        return self._forward(wished, self._rows, self._rest)[0], log_det + change

    def inverse_and_log_det(self, action: Tensor) -> tuple[Tensor, Tensor]:
        point, log_det = action, log_det_zero(action)
        if self._rest is not None:
            offset, log_det = self._rest.inverse_and_log_det(point)
            point = self.region.anchor + offset
        if self._rows is not None:
            point, softened = self._rows.inverse(point, self._scale)
            log_det = log_det + softened
        if self._half_width is None or self._middle is None:
            return point, log_det
        return (point - self._middle) / self._half_width, log_det - self._half_width.log().sum(-1)

    def contains(self, action: Tensor) -> Tensor:
        if self._is_alone:
            # Its inverse is finite for all that lies strictly inside.
            return super().contains(action) & self._given.contains(action)
        return super().contains(action)

    def stages(self, latent: Tensor) -> Stages:
        wished, log_det = self._in_action_units(latent)

        def stage(count: int) -> tuple[Tensor, Tensor]:
            rows = self._rows_of(count)
            action, change = self._forward(wished, rows, self._rest_of(count, rows))
            return action, log_det + change

        return stacked(stage(count) for count in range(1, len(self._given.sets) + 1))

    def _in_action_units(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        if self._half_width is None or self._middle is None:
            return latent, log_det_zero(latent)
        wished = torch.addcmul(self._middle, latent, self._half_width)
        return wished, self._half_width.log().sum(-1).expand(wished.shape[:-1])

    def _forward(
        self, wished: Tensor, rows: _Rows | None, rest: SoftContraction | None
    ) -> tuple[Tensor, Tensor]:
        if rows is None:
            point, log_det = wished, log_det_zero(wished)
        else:
            point, moved = rows.forward(wished, self._scale)
            log_det = -moved
        if rest is None:
            return point, log_det
        offset = point - self.region.anchor
        action, change = rest.forward_and_log_det(offset, torch.zeros_like(offset))
        return action, log_det + change

    def _rows_of(self, count: int) -> _Rows | None:
        """Return the rows of the half-spaces among the first sets."""
        sets = self._given.widened()
        chosen = [
            (constraint_set, self._given.counts(stage))
            for stage, constraint_set in enumerate(sets[:count])
            if isinstance(constraint_set, HalfSpaces)
        ]
        if not chosen:
            return None
        magnitude = None if self._is_alone else self._given.bounds.magnitude()
        return _Rows.of(chosen, self._way_out, magnitude)

    def _rest_of(self, count: int, rows: _Rows | None) -> SoftContraction | None:
        """Return the retraction from the rows' intersection onto the first sets."""
        if self._is_alone:
            return None
        anchor = self.region.anchor
        # All along rays, also without rows: a set that is dropped must be as if it were not there.
        outer = None if rows is None else rows.half_spaces().gauge_about(anchor)
        return SoftContraction(outer, [], self.region.sets[:count], anchor, self._sharpness)

    def _refuse_other_sets(self, region: Region) -> None:
        others = [type(s).__name__ for s in region.sets[1:] if not isinstance(s, HalfSpaces)]
        if others:
            raise GeometryError(
                f"sets: expected half-spaces alone in a region without an anchor, given {others}; "
                "find an anchor with Region.build(sets)"
            )

    def _refuse_bounds(self, bounds: Box) -> None:
        if not self._is_alone:
            require_action_bounds(bounds)
        elif bool((bounds.low.isfinite() | bounds.high.isfinite()).any()):
            raise GeometryError(
                "action bounds: expected infinite ones in a region without an anchor, given low "
                f"{bounds.low.tolist()}, high {bounds.high.tolist()}; find an anchor with "
                "Region.build(sets), or state the bounds as half-spaces"
            )

    def _refuse_no_way_out(self) -> None:
        if self._rows is None or bool(self._rows.has_way_out.all()):
            return
        index = (~self._rows.has_way_out).nonzero()[0].tolist()
        raise GeometryError(
            f"half-spaces: expected a direction that leaves no row closer than {LEAST_MARGIN:g} of "
            f"its length, given rows without one at index {index}; give the region an anchor "
            "(Region.build(sets)), and it is softly retracted there"
        )


class _Rows(NamedTuple):
    """The rows of half-spaces, and a common way out of them.

    Rounding is made up for twice: rows are eroded by that of the wished action, and the way is
    longer by that of its own length. That of an offset is smaller: only a row that is no further
    away than the action can be broken.

    Args:
        normals: Outward unit normals, ``(*batch, m, d)``.
        offsets: Offsets, ``(*batch, m)``; a large number for rows that do not count, since the
            gradient of infinity would be NaN.
        back: Unit vectors -r, ``(*batch, d)``.
        rates: How fast the way leads away from each row, :math:`-A_k r`, ``(*batch, m)``.
        stretch: How much longer the way is than it must be, as a share, ``(*batch,)``; NaN where
            there is no way out and no anchor either.
        has_way_out: Where there is a way out, boolean ``(*batch,)``.
        magnitude: The size of points that offsets are eroded for, ``(*batch, 1)``; None is 0.
    """

    normals: Tensor
    offsets: Tensor
    back: Tensor
    rates: Tensor
    stretch: Tensor
    has_way_out: Tensor
    magnitude: Tensor | None

    @classmethod
    def of(
        cls,
        sets: Sequence[tuple[HalfSpaces, Tensor | None]],
        way_out: Tensor | None,
        magnitude: Tensor | None,
    ) -> _Rows:
        """Return the rows of sets, each with where it is not dropped (None: everywhere).

        Args:
            sets: Half-spaces.
            way_out: Vectors r of any length, ``(*batch, d)``; None finds one.
            magnitude: The size of points, ``(*batch,)``. None is 0, for a region without an anchor,
                where actions are NaN if there is no way out, and not left as they are.
        """
        normals, offsets = _unit_rows(sets)
        info = torch.finfo(offsets.dtype)
        far = info.max * LEAST_MARGIN**3
        offsets = offsets.clamp(max=far)
        binds = offsets < far
        back = hull_point(normals, binds) if way_out is None else -way_out
        back = back / vector_norm(back, dim=-1, keepdim=True).clamp(min=info.tiny)
        rates = torch.where(binds, (normals * back.unsqueeze(-2)).sum(-1), 1)
        least = rates.amin(-1)
        has_way_out = least > LEAST_MARGIN
        # A step along r is rounded in proportion to itself, which a row sees as a share of its
        # rate.
        stretch = EROSION_IN_EPS * info.eps * least.detach().reciprocal()
        if magnitude is None:
            stretch = torch.where(has_way_out, stretch, torch.nan)
        else:
            moves = has_way_out.unsqueeze(-1)
            magnitude = magnitude.unsqueeze(-1)
            offsets = torch.where(moves & binds, offsets - _erosion(normals) * magnitude, far)
            rates = torch.where(moves, rates, 1)
            stretch = torch.where(has_way_out, stretch, 0)
        return cls(normals, offsets, back, rates, stretch, has_way_out, magnitude)

    def half_spaces(self) -> HalfSpaces:
        """Return the half-spaces, eroded for the magnitude."""
        return HalfSpaces(self.normals, self.offsets, validate_args=False)

    def forward(self, wished: Tensor, scale: float) -> tuple[Tensor, Tensor]:
        """Return the actions, and softplus(need/s), ``(*batch,)``."""
        moved = softened(self._need(wished, wished) / scale)
        return self._along(wished, scale * moved), moved

    def inverse(self, action: Tensor, scale: float) -> tuple[Tensor, Tensor]:
        """Return the wished actions, and softplus(need/s), ``(*batch,)``."""
        with torch.no_grad():
            # Erosion is that of the wished action, which is not known yet.
            moved = _softened_of_left(-self._need(action, action) / scale)
            wished = self._along(action, -scale * moved)
            known = wished.isfinite().all(-1)
            wished = torch.where(known.unsqueeze(-1), wished, action)
            stretched = self.stretch * torch.where(known, scale * moved, 0)
        moved = _softened_of_left(-(self._need(action, wished) + stretched) / scale)
        return self._along(action, -scale * moved), moved

    def _need(self, point: Tensor, wished: Tensor) -> Tensor:
        """Return how far to go along the way out until all rows hold, negative if they do.

        Args:
            point: Points ``(*batch, d)``.
            wished: The actions that rows are eroded for, ``(*batch, d)``.
        """
        size = wished.detach().abs().amax(-1, keepdim=True)
        if self.magnitude is not None:
            size = (size - self.magnitude).relu()
        beyond = (self.normals * point.unsqueeze(-2)).sum(-1) - self.offsets
        return (torch.add(beyond, size, alpha=_erosion(self.normals)) / self.rates).amax(-1)

    def _along(self, point: Tensor, way: Tensor) -> Tensor:
        way = torch.addcmul(way, way.detach(), self.stretch)
        return torch.addcmul(point, way.unsqueeze(-1), self.back, value=-1)


def _erosion(normals: Tensor) -> float:
    """Return the rounding error of unit rows at points whose largest component is 1."""
    dim: int = normals.shape[-1]
    return EROSION_IN_EPS * torch.finfo(normals.dtype).eps * dim**0.5


def _unit_rows(sets: Sequence[tuple[HalfSpaces, Tensor | None]]) -> tuple[Tensor, Tensor]:
    """Return unit normals ``(*batch, m, d)`` and offsets, infinite for rows that do not count."""
    normals, offsets = [], []
    for half_spaces, counts in sets:
        normal, offset = half_spaces.normals, half_spaces.offsets
        # Twice, so that no square underflows.
        size = normal.detach().abs().amax(-1)
        zero = size.logical_not()
        size = size.masked_fill(zero, 1)
        normal = normal / size.unsqueeze(-1)
        length = vector_norm(normal, dim=-1).clamp(min=1)
        offset = offset / size / length
        passes = zero & (offset >= 0)
        if counts is not None:
            passes = passes | ~counts.unsqueeze(-1)
        normals.append(normal / length.unsqueeze(-1))
        offsets.append(offset.masked_fill(passes, torch.inf))
    if len(sets) == 1 and normals[0].shape[:-1] == offsets[0].shape:
        return normals[0], offsets[0]
    shape = broadcast_shape(*(n.shape[:-2] for n in normals), *(o.shape[:-1] for o in offsets))
    joined = torch.cat([n.expand(*shape, *n.shape[-2:]) for n in normals], -2)
    return joined, torch.cat([o.expand(*shape, o.shape[-1]) for o in offsets], -1)


def hull_point(normals: Tensor, binds: Tensor) -> Tensor:
    """Return a multiple of the point of least length in the hull of unit normals, ``(*batch, d)``.

    Its opposite leads away from all rows with the largest margin. It is exact for up to two rows;
    for more it is found in float64 in a fixed number of steps, and its gradient is that of the rows
    that decide. Where the hull contains 0 nothing leads away from all rows.

    Args:
        normals: Unit normals, ``(*batch, m, d)``.
        binds: Which rows count, boolean ``(*batch, m)``.
    """
    if normals.shape[-2] <= 2:
        # The point of least length between two unit vectors is their middle.
        return (normals * binds.unsqueeze(-1)).sum(-2)
    rows = normals.double() * binds.unsqueeze(-1)
    identity = torch.eye(rows.shape[-2], dtype=rows.dtype, device=rows.device)
    # With a small multiple of the identity, for rows that are equal.
    gram = rows @ rows.mT + _RIDGE * identity
    deciding = _deciding_rows(gram.detach(), binds)
    both = deciding.unsqueeze(-1) & deciding.unsqueeze(-2)
    solved = torch.linalg.solve(torch.where(both, gram, identity), deciding.double())
    return (rows * solved.unsqueeze(-1)).sum(-2).to(normals.dtype)


@torch.no_grad()
def _deciding_rows(gram: Tensor, binds: Tensor) -> Tensor:
    """Return which rows the point of least length in a hull lies between, boolean ``(*batch, m)``.

    Minimizes the point's square over weights w >= 0 of sum 1, with a multiplier s >= 0 for each
    row, by primal-dual interior-point steps (Wright 1997): in the end w is far above s for rows
    that decide, and far below for the others.

    Args:
        gram: Products of all rows, ``(*batch, m, m)``.
        binds: Which rows count, boolean ``(*batch, m)``; rows that do not are zero.
    """
    # A row that does not count would be the shortest point; it costs more than any other can.
    cost = torch.where(binds, 0.0, 4.0).to(gram.dtype)
    weights = torch.full_like(cost, 1 / cost.shape[-1])
    slopes = (gram @ weights.unsqueeze(-1)).squeeze(-1) + cost
    multipliers = slopes - slopes.amin(-1, keepdim=True) + 1
    for _ in range(_STEPS):
        ratios = multipliers / weights
        target = _CENTERING * (weights * multipliers).mean(-1, keepdim=True)
        change = target / weights - multipliers
        factor, _ = torch.linalg.cholesky_ex(gram + torch.diag_embed(ratios))
        both = torch.stack([change, torch.ones_like(change)], -1)
        free, uniform = torch.cholesky_solve(both, factor).unbind(-1)
        # The weights' sum stays 1.
        uniform = uniform * (free.sum(-1, keepdim=True) / uniform.sum(-1, keepdim=True))
        weights_change = free - uniform
        multipliers_change = change - ratios * weights_change
        shrinks = torch.cat([weights_change / weights, multipliers_change / multipliers], -1)
        step = (_SHARE / -shrinks.amin(-1, keepdim=True).clamp(max=-_SHARE)).clamp(max=1)
        weights = weights + step * weights_change
        multipliers = multipliers + step * multipliers_change
    return weights > multipliers


def softened(need: Tensor) -> Tensor:
    """Return softplus, computed where it differs from its argument in float64, too."""
    return softplus(need, threshold=_LARGEST_SOFT)


def _softened_of_left(left: Tensor) -> Tensor:
    """Return softplus(need) of what is left before the rows, softplus(-need); NaN beyond them."""
    return -(-torch.expm1(-left)).log()


def require_scale(scale: float) -> float:
    """Return a positive finite scale, or refuse it.

    Raises:
        ValueError: when it is out of range.
    """
    if not 0 < scale < float("inf"):
        raise ValueError(f"scale: expected a number > 0, given {scale}")
    return float(scale)
