"""Half-spaces: linear inequalities on actions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Self

import torch
from torch import Tensor
from torch.linalg import vector_norm

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
    _kept: ClassVar[Rows | None] = None  # an instance's own where it is known

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
        rows = self.to(torch.float64).superlevel()
        return (_rows(rows.normals, action.double()) <= rows.offsets).all(-1)

    def slack(self, action: Tensor) -> Tensor:
        return self.row_slacks(action).amin(-1)

    def row_slacks(self, action: Tensor) -> Tensor:
        """Return the distances to the rows' boundaries, ``(*batch, m)``."""
        rows = self.superlevel()
        return (rows.offsets - _rows(rows.normals, action)) / rows.rates

    def row_count(self) -> int:
        return self.normals.shape[-2]

    def inflated(self, by: Tensor) -> Self:
        rows = self.superlevel()
        return self._with(rows, rows.offsets + by * rows.rates)

    def rounding(self, magnitude: Tensor | float = 1.0) -> Tensor:
        rows = self.superlevel()
        return (self._erosion(rows, magnitude) / rows.rates).masked_fill(rows.offsets.isinf(), 0)

    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        return self.gauge_about(anchor)(direction)

    def gauge_about(self, anchor: Tensor) -> Gauge:
        rows = self.superlevel()
        room = rows.offsets - _rows(rows.normals, anchor)
        return partial(_gauge, rows.normals, room.reciprocal())

    def bounding_box(self) -> Bounds:
        """Return the bounds set by rows along an axis; the others are infinite."""
        single = (self.normals != 0).sum(-1, keepdim=True) == 1
        bound = self.offsets.unsqueeze(-1) / self.normals
        high = torch.where(single & (self.normals > 0), bound, torch.inf).amin(-2)
        low = torch.where(single & (self.normals < 0), bound, -torch.inf).amax(-2)
        return Bounds(low, high)

    def eroded(self, magnitude: Tensor | float = 1.0) -> Self:
        rows = self.superlevel()
        moved = rows.offsets - self._erosion(rows, magnitude)
        return self._with(rows, torch.where(rows.offsets.isinf(), rows.offsets, moved))

    def _erosion(self, rows: Rows, magnitude: Tensor | float) -> Tensor:
        """Return by how much `eroded` lowers offsets, ``(*batch, m)``; infinite as they are."""
        largest = torch.as_tensor(magnitude, dtype=self.dtype, device=self.normals.device)
        size = rows.normals.abs().sum(-1) * largest.unsqueeze(-1) + rows.offsets.abs()
        return EROSION_IN_EPS * torch.finfo(self.dtype).eps * size

    def around(self, center: Tensor, radius: Tensor) -> Self:
        normals = torch.zeros_like(self.normals[..., :1, :])
        normals[..., 0] = 1
        offsets = center[..., :1] + radius.unsqueeze(-1)
        return type(self)(
            normals.expand_as(self.normals),
            offsets.expand(*offsets.shape[:-1], self.offsets.shape[-1]),
            validate_args=False,
        )

    def superlevel(self) -> Rows:
        if self._kept is not None:
            return self._kept
        # Normals of about unit length, which do not vanish when squared. An offset out of range
        # beside its normal becomes infinite: no action reaches that row.
        unit = power_of_two(self.normals.abs().amax(-1))
        normals = self.normals / unit.unsqueeze(-1)
        lengths = vector_norm(normals, dim=-1)
        zero = lengths == 0
        rows = Rows(normals, self._passed(zero, self.offsets / unit), lengths.masked_fill(zero, 1))
        # What was found without gradients must not be used with them.
        if not (self.normals.requires_grad or self.offsets.requires_grad):
            self._keep(rows)
        return rows

    @staticmethod
    def _passed(zero: Tensor, offsets: Tensor) -> Tensor:
        """Return offsets, infinite where a normal of zero lets every action pass, not none."""
        return torch.where(zero & (offsets >= 0), torch.inf, offsets)

    def _with(self, rows: Rows, offsets: Tensor) -> Self:
        """Return the set with the normals of some rows and other offsets."""
        offsets = self._passed((rows.normals == 0).all(-1), offsets)
        moved = type(self)(rows.normals, offsets, validate_args=False)
        moved._keep(Rows(rows.normals, offsets, rows.rates))
        return moved

    def _keep(self, rows: Rows) -> None:
        # A compiler sees by itself what is computed twice.
        if not torch.compiler.is_compiling():
            object.__setattr__(self, "_kept", rows)


def _gauge(normals: Tensor, inverse_room: Tensor, direction: Tensor) -> Tensor:
    return (_rows(normals, direction) * inverse_room).amax(-1).relu()


def _rows(normals: Tensor, vector: Tensor) -> Tensor:
    return (normals * vector.unsqueeze(-2)).sum(-1)
