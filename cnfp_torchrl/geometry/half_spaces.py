"""Half-spaces: linear inequalities on actions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, NamedTuple, Self

import torch
from torch import Tensor

from cnfp_torchrl.geometry.constraint_set import (
    EROSION_IN_EPS,
    Bounds,
    ConstraintSet,
    Gauge,
    largest_value,
)
from cnfp_torchrl.geometry.norms import power_of_two
from cnfp_torchrl.geometry.superlevel import Rows


@dataclass(frozen=True, eq=False)
class HalfSpaces(ConstraintSet):
    r"""The intersection of half-spaces, :math:`\{a : normals_j \cdot a \le offsets_j\}`.

    It need not be bounded. A control barrier function gives one row,
    :math:`-L_g h \cdot a \le L_f h + \alpha(h)`. A row whose normal is zero lets every action pass
    if its offset is 0 or more, else none. Rows are relaxed one by one, each by a distance, or by an
    offset where the normal is zero.

    Args:
        normals: Outward normals of the rows, ``(*batch, m, d)``, finite.
        offsets: Offsets of the rows, ``(*batch, m)``; infinite ones let every action pass.
    """

    normals: Tensor
    offsets: Tensor

    event_dims: ClassVar[Mapping[str, int]] = {"normals": 2, "offsets": 1}
    finite_fields: ClassVar[frozenset[str]] = frozenset({"normals"})
    _kept: ClassVar[_Rows | None] = None  # an instance's own where it is known

    def invalid_fields(self) -> Iterator[tuple[str, Tensor, str]]:
        yield "offsets", self.offsets.isneginf(), "an offset above -inf"
        size, most = self.normals.abs().amax(-1), largest_value(self.dtype)
        far = (-self.offsets / most > size) & (size > 0)
        yield "offsets", far, f"an offset above {-most:g} times the normal's largest element"

    def shape_problem(self) -> str | None:
        rows, offsets = self.normals.shape[-2], self.offsets.shape[-1]
        if rows == offsets and rows > 0:
            return None
        return f"expected as many offsets as normals, at least 1, given {offsets} and {rows}"

    @classmethod
    def fields_of_other_width(cls) -> frozenset[str]:
        return frozenset({"offsets"})

    def contains(self, action: Tensor) -> Tensor:
        rows = self.to(torch.float64)._rows_last(action.ndim - 1)
        return (rows.along(action.double()) <= rows.offsets).all(0)

    def slack(self, action: Tensor) -> Tensor:
        return self._slacks(action).amin(0)

    def row_slacks(self, action: Tensor) -> Tensor:
        """Return the distances to the rows' boundaries, ``(*batch, m)``."""
        return self._slacks(action).movedim(0, -1)

    def _slacks(self, action: Tensor) -> Tensor:
        """Return the distances to the rows' boundaries, ``(m, *batch)``."""
        rows = self._rows_last(action.ndim - 1)
        return (rows.offsets - rows.along(action)) / rows.rates

    def row_count(self) -> int:
        return self.normals.shape[-2]

    def inflated(self, by: Tensor) -> Self:
        rows = self._rows_last(by.ndim - 1)
        return self._with(rows, rows.offsets + by.movedim(-1, 0) * rows.rates)

    def rounding(self, magnitude: Tensor | float = 1.0) -> Tensor:
        rows, erosion = self._erosion(magnitude)
        return (erosion / rows.rates).masked_fill(rows.offsets.isinf(), 0).movedim(0, -1)

    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        return self.gauge_about(anchor)(direction)

    def gauge_about(self, anchor: Tensor) -> Gauge:
        rows = self._rows_last(anchor.ndim - 1)
        room = rows.offsets - rows.along(anchor)
        return partial(_gauge, rows._replace(offsets=room.reciprocal()))

    def bounding_box(self) -> Bounds:
        """Return the bounds set by rows along an axis; the others are infinite."""
        normals, offsets, _ = self._rows_last()
        slanted = (normals != 0).sum(1) != 1
        bound = offsets.masked_fill(slanted, torch.inf).unsqueeze(1) / normals
        high = bound.masked_fill(normals <= 0, torch.inf).amin(0)
        low = bound.masked_fill(normals >= 0, -torch.inf).amax(0)
        return Bounds(low.movedim(0, -1), high.movedim(0, -1))

    def deepest_within(self, box: Bounds) -> Tensor | None:
        """Return a point of the box that is farthest inside of the row, if there is one row."""
        if self.row_count() > 1:
            return None
        away = self.normals.squeeze(-2).sign()
        return torch.lerp(box.low, box.high, (1 - away) / 2)

    def eroded(self, magnitude: Tensor | float = 1.0) -> Self:
        rows, erosion = self._erosion(magnitude)
        moved = rows.offsets - erosion
        return self._with(rows, torch.where(rows.offsets.isinf(), rows.offsets, moved))

    def _erosion(self, magnitude: Tensor | float) -> tuple[_Rows, Tensor]:
        """Return the rows, and by how much `eroded` lowers their offsets, infinite as they are."""
        largest = torch.as_tensor(magnitude, dtype=self.dtype, device=self.normals.device)
        rows = self._rows_last(largest.ndim)
        size = rows.normals.abs().sum(1) * largest + rows.offsets.abs()
        return rows, EROSION_IN_EPS * torch.finfo(self.dtype).eps * size

    def around(self, center: Tensor, radius: Tensor) -> Self:
        normals = torch.zeros_like(self.normals[..., :1, :])
        normals[..., 0] = 1
        offsets = center[..., :1] + radius.unsqueeze(-1)
        return type(self)(
            normals.expand_as(self.normals),
            offsets.expand(*offsets.shape[:-1], self.offsets.shape[-1]),
            validate_args=False,
        )

    def select(self, batch_shape: torch.Size, index: Tensor) -> Self:
        if self._kept is None:
            return super().select(batch_shape, index)
        return self._of(self._kept.select(batch_shape, index))

    def superlevel(self) -> Rows:
        return self._rows_last().batch_first()

    def _rows_last(self, batch_dims: int = 0) -> _Rows:
        """Return the rows in about unit length, with at least so many batch dimensions."""
        if self._kept is not None:
            return self._kept.spread(batch_dims)
        own_dims = max(self.normals.ndim - 2, self.offsets.ndim - 1)
        normals = _spread(self.normals.movedim((-2, -1), (0, 1)), 2, own_dims).contiguous()
        offsets = _spread(self.offsets.movedim(-1, 0), 1, own_dims).contiguous()
        # Normals that do not vanish when squared. An offset out of range beside its normal becomes
        # infinite: no action reaches that row.
        unit = power_of_two(normals.abs().amax(1))
        normals = normals / unit.unsqueeze(1)
        # Not `torch.linalg.vector_norm`, which is slow along the first dimensions.
        squares = normals.square().sum(1)
        zero = squares == 0
        rates = squares.masked_fill(zero, 1).sqrt()
        rows = _Rows(normals, _passed(zero, offsets / unit), rates)
        # What was found without gradients must not be used with them.
        if not (self.normals.requires_grad or self.offsets.requires_grad):
            self._keep(rows)
        return rows.spread(batch_dims)

    def _with(self, rows: _Rows, offsets: Tensor) -> Self:
        """Return the set with the normals of some rows and other offsets."""
        return self._of(rows._replace(offsets=_passed((rows.normals == 0).all(1), offsets)))

    def _of(self, rows: _Rows) -> Self:
        """Return the set of some rows."""
        known = rows.batch_first()
        half_spaces = type(self)(known.normals, known.offsets, validate_args=False)
        half_spaces._keep(rows)
        return half_spaces

    def _keep(self, rows: _Rows) -> None:
        # A compiler sees by itself what is computed twice. Inference tensors are of no use later.
        if torch.compiler.is_compiling():
            return
        if rows.normals.is_inference() == self.normals.is_inference():
            object.__setattr__(self, "_kept", rows)


class _Rows(NamedTuple):
    """Rows with the batch last, over which arithmetic on a few components is some times as fast.

    Attributes:
        normals: Normals, ``(m, d, *batch)``.
        offsets: Offsets, ``(m, *batch)``.
        rates: Lengths of the normals, 1 for a normal of zero, ``(m, *batch)``.
    """

    normals: Tensor
    offsets: Tensor
    rates: Tensor

    def spread(self, batch_dims: int) -> _Rows:
        """Return the rows with at least so many batch dimensions."""
        if self.offsets.ndim > batch_dims:
            return self
        events = (2, 1, 1)
        return _Rows(*(_spread(v, n, batch_dims) for v, n in zip(self, events, strict=True)))

    def select(self, batch_shape: torch.Size, index: Tensor) -> _Rows:
        """Return the rows of some batch elements, given by their flat indices in a batch shape."""
        rows = self.spread(len(batch_shape))
        events = [value.shape[: value.ndim - len(batch_shape)] for value in rows]
        all_rows = (v.expand(*event, *batch_shape) for v, event in zip(rows, events, strict=True))
        flat = (v.reshape(*event, -1) for v, event in zip(all_rows, events, strict=True))
        return _Rows(*(value.index_select(-1, index) for value in flat))

    def batch_first(self) -> Rows:
        """Return the description of the rows."""
        normals = self.normals.movedim((0, 1), (-2, -1))
        return Rows(normals, self.offsets.movedim(0, -1), self.rates.movedim(0, -1))

    def along(self, vector: Tensor) -> Tensor:
        """Return the products with vectors ``(*batch, d)``, of no more dimensions than here."""
        vector = _spread(vector.movedim(-1, 0), 1, self.offsets.ndim - 1)
        return (self.normals * vector).sum(1)


def _passed(zero: Tensor, offsets: Tensor) -> Tensor:
    """Return offsets, infinite where a normal of zero lets every action pass, not none."""
    return torch.where(zero & (offsets >= 0), torch.inf, offsets)


def _spread(value: Tensor, events: int, batch_dims: int) -> Tensor:
    """Return values ``(*event, *batch)`` with at least so many batch dimensions."""
    missing = events + batch_dims - value.ndim
    if missing <= 0:
        return value
    return value.reshape(*value.shape[:events], *(1,) * missing, *value.shape[events:])


def _gauge(rows: _Rows, direction: Tensor) -> Tensor:
    rows = rows.spread(direction.ndim - 1)
    return (rows.along(direction) * rows.offsets).amax(0).relu()
