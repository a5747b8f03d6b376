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
        normals: outward normals of the rows, ``(*batch, m, d)``, finite.
        offsets: offsets of the rows, ``(*batch, m)``; infinite ones let every action pass.
    """

    normals: Tensor
    offsets: Tensor

    event_dims: ClassVar[Mapping[str, int]] = {"normals": 2, "offsets": 1}
    finite_fields: ClassVar[frozenset[str]] = frozenset({"normals"})

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
        sets = self.to(torch.float64)._normalized()
        return (_rows(sets.normals, action.double()) <= sets.offsets).all(-1)

    def slack(self, action: Tensor) -> Tensor:
        return self.row_slacks(action).amin(-1)

    def row_slacks(self, action: Tensor) -> Tensor:
        """Return the distances to the rows' boundaries, ``(*batch, m)``."""
        rows = self.superlevel()
        return (rows.offsets - _rows(rows.normals, action)) / rows.rates

    def inflated(self, by: Tensor) -> Self:
        rows = self.superlevel()
        return type(self)(rows.normals, rows.offsets + by * rows.rates, validate_args=False)

    def rounding(self, magnitude: Tensor | float = 1.0) -> Tensor:
        rows, eps = self.superlevel(), EROSION_IN_EPS * torch.finfo(self.dtype).eps
        largest = torch.as_tensor(magnitude, dtype=self.dtype, device=self.normals.device)
        size = rows.normals.abs().sum(-1) * largest.unsqueeze(-1) + rows.offsets.abs()
        return (eps * size / rows.rates).masked_fill(rows.offsets.isinf(), 0)

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
        eps = EROSION_IN_EPS * torch.finfo(self.dtype).eps
        largest = torch.as_tensor(magnitude, dtype=self.dtype, device=self.normals.device)
        sets = self._normalized()
        size = sets.normals.abs().sum(-1) * largest.unsqueeze(-1) + sets.offsets.abs()
        offsets = torch.where(sets.offsets.isinf(), sets.offsets, sets.offsets - eps * size)
        return type(self)(sets.normals, offsets, validate_args=False)

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
        sets = self._normalized()
        lengths = vector_norm(sets.normals, dim=-1)
        zero = lengths == 0
        # A normal of zero lets every action pass or none.
        offsets = torch.where(zero & (sets.offsets >= 0), torch.inf, sets.offsets)
        return Rows(sets.normals, offsets, lengths.masked_fill(zero, 1))

    def _normalized(self) -> Self:
        """Return the same set with normals of about unit length, which do not vanish when squared.

        An offset out of range beside its normal becomes infinite: no action reaches that row.
        """
        unit = power_of_two(self.normals.abs().amax(-1))
        return type(self)(
            self.normals / unit.unsqueeze(-1), self.offsets / unit, validate_args=False
        )


def _gauge(normals: Tensor, inverse_room: Tensor, direction: Tensor) -> Tensor:
    return (_rows(normals, direction) * inverse_room).amax(-1).relu()


def _rows(normals: Tensor, vector: Tensor) -> Tensor:
    return (normals * vector.unsqueeze(-2)).sum(-1)
