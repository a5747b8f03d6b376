"""The contract of a set of allowed actions, a batched value made of plain tensors."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import InitVar, dataclass
from functools import partial
from typing import ClassVar, NamedTuple, Self, TypeAlias

import torch
from torch import Tensor

from cnfp_torchrl.geometry.superlevel import Superlevel

EROSION_IN_EPS = 16.0
"""The distance by which `ConstraintSet.eroded` moves a boundary, in units of rounding error."""

Gauge: TypeAlias = Callable[[Tensor], Tensor]
"""The gauge of a set about an anchor, from directions ``(*batch, d)`` to values ``(*batch,)``."""


def broadcast_shape(*shapes: torch.Size) -> torch.Size:
    """Return the shape that shapes broadcast to.

    Faster than `torch.broadcast_shapes` where all shapes are equal or empty.
    """
    known = [shape for shape in shapes if len(shape)]
    if all(shape == known[0] for shape in known):
        return known[0] if known else torch.Size()
    return torch.broadcast_shapes(*known)


def largest_value(dtype: torch.dtype) -> float:
    """Return the largest finite number that a field may hold: 1e33 in float32, 1e150 in float64.

    Sums of many such numbers stay finite, and so do their squares in float64, in which anchors are
    searched for.
    """
    return 1e33 if dtype == torch.float32 else 1e150


class Bounds(NamedTuple):
    """Lower and upper bounds of the components of actions.

    Args:
        low: Lower bounds ``(*batch, d)``, minus infinity where none is known.
        high: Upper bounds ``(*batch, d)``, infinity where none is known.
    """

    low: Tensor
    high: Tensor


class Evidence(NamedTuple):
    """A number of a batch of states that tells on which side of a limit all of them are.

    Args:
        value: The number or flag, ``()``.
        limit: The largest absolute value that is good; NaN never is.
    """

    value: Tensor
    limit: float


def extremes(values: Tensor, limit: float) -> list[Evidence]:
    """Return the least and the largest of some values, NaN if one is; nothing if there are none."""
    return [Evidence(value, limit) for value in values.aminmax()] if values.numel() else []


def are_within(values: Iterable[float], limits: Iterable[float]) -> bool:
    """Tell whether the values of evidence, read on the host, are within its limits."""
    return all(abs(value) <= limit for value, limit in zip(values, limits, strict=True))


class GeometryError(ValueError):
    """Invalid fields of a set; names the constraint, the field, the expected and the given."""


@dataclass(frozen=True, eq=False)
class ConstraintSet(ABC):
    """A batch of sets of allowed actions in R^d, one set for each batch element.

    A family is a frozen dataclass whose fields are floating tensors ``(*batch, *event)``; the batch
    shapes broadcast against each other and against the actions ``(*sample, *batch, d)``. A family
    states

    - `event_dims`: the number of event dimensions of each field,
    - `slack`, `gauge`: its geometry,
    - `eroded`: the set moved inwards by the rounding error of its own arithmetic,
    - `around`: a well-conditioned set of the family that contains a ball,

    and, where there is more to say than the defaults do,

    - `gauge_about`: the gauge with all that does not depend on the direction computed once,
    - `inflated`: the set widened, by which a constraint that cannot hold is relaxed; a family
      without it is dropped instead,
    - `row_slacks`, `rounding`: the rows that a set is made of, which are relaxed one by one,
    - `finite_fields`, `invalid_fields`, `shape_problem`: what makes fields invalid beyond shapes,
      dtypes and NaN,
    - `contains`, `bounding_box`: by default by `slack` and without bounds,
    - `superlevel`: a description of {slack >= t} that makes the search for anchors fast, and
      `part_near` if the set is not convex,
    - `deepest_within`: the deepest point within a box, which often spares that search.

    Constructing a set checks it, which reads tensors on the host. Hot paths construct sets with
    ``validate_args=False``: their values were checked where they entered.

    Raises:
        GeometryError: when a field has the wrong shape or dtype, contains NaN, or describes no set.
    """

    validate_args: InitVar[bool] = dataclasses.field(default=True, kw_only=True)
    event_dims: ClassVar[Mapping[str, int]]
    finite_fields: ClassVar[frozenset[str]] = frozenset()
    """The fields whose numbers must be finite; others may be infinite."""

    def __post_init__(self, validate_args: bool) -> None:
        if validate_args:
            self.validate()

    # What a family states -------------------------------------------------------------------------

    @abstractmethod
    def slack(self, action: Tensor) -> Tensor:
        """Return how far inside an action is: positive inside, negative outside, concave in it.

        The distance to the boundary, or a lower bound of it where that has no closed form.
        """

    @abstractmethod
    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        r"""Return the gauge about an anchor, :math:`g(v) = \inf\{t > 0 : c + v/t \in C\}`.

        The boundary lies at ``anchor + direction / gauge``. In directions in which the set is
        unbounded the gauge is 0.

        Args:
            direction: Vectors ``(*batch, d)``, none of them zero.
            anchor: Points strictly inside the set, ``(*batch, d)``; about others the result is
                meaningless.
        """

    @abstractmethod
    def eroded(self, magnitude: Tensor | float = 1.0) -> Self:
        """Return the set with its boundary moved inwards by a few units of rounding error.

        A point of the eroded set, computed in the set's dtype, lies in the true set with zero
        tolerance.

        Args:
            magnitude: The largest coordinate of the points, ``(*batch,)``.
        """

    @abstractmethod
    def around(self, center: Tensor, radius: Tensor) -> Self:
        """Return a set of this family that contains a ball, with fields shaped as here.

        It takes the place of a dropped set, with a ball that contains the action bounds.

        Args:
            center: The center of the ball, ``(*batch, d)``.
            radius: The radius of the ball, ``(*batch,)``, positive.
        """

    def inflated(self, by: Tensor) -> Self:
        """Return the set widened to all actions with a slack of at least ``-by``.

        Families that do not override this, such as non-convex ones, cannot be relaxed: where they
        cannot hold they are dropped.

        Args:
            by: Amounts in units of the slack, finite, 0 or more: ``(*batch, m)`` for the m rows of
                `row_slacks`, or ``(*batch, 1)`` for all rows alike.

        Raises:
            TypeError: when the family cannot be widened.
        """
        raise TypeError(f"{type(self).__name__}: expected a family that states `inflated`")

    @classmethod
    def can_be_inflated(cls) -> bool:
        """Tell whether the family states `inflated`."""
        return cls.inflated is not ConstraintSet.inflated

    @classmethod
    def is_convex(cls) -> bool:
        """Tell whether the family's sets are convex: it states no `part_near`."""
        return cls.part_near is ConstraintSet.part_near

    @classmethod
    def has_rows(cls) -> bool:
        """Tell whether the family states `row_slacks`: its sets are made of several rows."""
        return cls.row_slacks is not ConstraintSet.row_slacks

    def row_slacks(self, action: Tensor) -> Tensor:
        """Return the slacks of the m rows that the set is made of, ``(*batch, m)``.

        The smallest of them is `slack`. By default the set is one row.
        """
        return self.slack(action).unsqueeze(-1)

    def row_count(self) -> int:
        """Return the number m of the rows of `row_slacks`."""
        if not self.has_rows():
            return 1
        like = next(value for name, value in self.fields().items() if self.event_dims[name] > 0)
        return int(self.row_slacks(like.new_zeros(self.dim)).shape[-1])

    def rounding(self, magnitude: Tensor | float = 1.0) -> Tensor:
        """Return how far `eroded` moves the boundary of each row inwards, ``(*batch, m)``."""
        like = next(value for name, value in self.fields().items() if self.event_dims[name] > 0)
        zero = like.new_zeros(self.dim)
        moved = self.row_slacks(zero) - self.eroded(magnitude).row_slacks(zero)
        # 0, not NaN, for rows that let every action pass and for a set without a slack at 0.
        return moved.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)

    def gauge_about(self, anchor: Tensor) -> Gauge:
        """Return the gauge about an anchor, with all that directions share computed once.

        Args:
            anchor: Points strictly inside the set, ``(*batch, d)``.
        """
        return partial(_gauge_at, self, anchor)

    def invalid_fields(self) -> Iterator[tuple[str, Tensor, str]]:
        """Yield (field, mask of its bad elements, the expected) for each rule of the family."""
        yield from ()

    def contains(self, action: Tensor) -> Tensor:
        """Tell, with zero tolerance, whether each action ``(*batch, d)`` lies in its set.

        Computed in float64 whatever the dtype, so that the answer is about the given numbers, not
        about rounding errors of the test.
        """
        return self.to(torch.float64).slack(action.double()) >= 0

    def bounding_box(self) -> Bounds:
        """Return bounds of the set's actions, infinite where none are known."""
        like = next(iter(self.fields().values()))
        high = torch.full((self.dim,), torch.inf, dtype=like.dtype, device=like.device)
        return Bounds(-high, high)

    def deepest_within(self, box: Bounds) -> Tensor | None:
        """Return the points of a box with the largest slack, where they have a closed form.

        With them the cheapest attempts at an anchor decide most states. A box that is empty may
        have any.

        Args:
            box: Bounds, finite, ``(*batch, d)``.

        Returns:
            Points ``(*batch, d)``; None, the default, where there is no such form.
        """
        return None

    def superlevel(self) -> Superlevel | None:
        """Describe the actions with a slack of at least t, for the search for anchors.

        With None, the default, the search linearizes `slack`: right for any concave slack, but
        slower. A non-convex family describes one convex part of its set here, and others in
        `part_near`.
        """
        return None

    def part_near(self, point: Tensor) -> Superlevel | None:
        """Describe a convex part that has as much slack at a point as the whole set has.

        Only non-convex families override this: a convex set is its own and only part.

        Args:
            point: Points ``(*batch, d)``.
        """
        return self.superlevel()

    def parts_near(self, point: Tensor) -> Superlevel | None:
        """Describe several convex parts, the one with the point closest to a point among them.

        For the projection. Only non-convex families override this; None, the default, says that the
        set is convex.

        Args:
            point: Points ``(*batch, d)``.

        Returns:
            A description of batch shape ``(parts, *batch)``.
        """
        return None

    # What follows from it -------------------------------------------------------------------------

    def fields(self) -> dict[str, Tensor]:
        """Return the fields by name, in the order of the constructor."""
        return {name: getattr(self, name) for name in self.event_dims}

    @property
    def batch_shape(self) -> torch.Size:
        """The shape that the batch shapes of all fields broadcast to."""
        fields = ((getattr(self, name).shape, dims) for name, dims in self.event_dims.items())
        return broadcast_shape(*(shape[: len(shape) - dims] for shape, dims in fields))

    @property
    def dim(self) -> int:
        """The dimension d of the action space."""
        for name, dims in self.event_dims.items():
            if dims > 0:
                return int(getattr(self, name).shape[-1])
        raise GeometryError(f"{type(self).__name__}: expected a field with event dimensions")

    @property
    def dtype(self) -> torch.dtype:
        """The floating type of the fields."""
        return getattr(self, next(iter(self.event_dims))).dtype

    def to(
        self, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> Self:
        """Return the set with all fields in a dtype and on a device, itself if nothing changes.

        Rounding of the fields moves the boundary by less than `eroded` does.
        """
        if device is None and dtype in (None, self.dtype):
            return self
        return self.with_fields(lambda field, _: field.to(device, dtype))

    def with_fields(self, change: Callable[[Tensor, int], Tensor]) -> Self:
        """Return the set with each field replaced by a function of it and its event dimensions."""
        changed = {n: change(value, self.event_dims[n]) for n, value in self.fields().items()}
        return type(self)(**changed, validate_args=False)

    def select(self, batch_shape: torch.Size, index: Tensor) -> Self:
        """Return the sets of some batch elements, given by their flat indices in a batch shape."""

        def chosen(field: Tensor, event_dims: int) -> Tensor:
            event = field.shape[field.ndim - event_dims :]
            return field.expand((*batch_shape, *event)).reshape(-1, *event)[index]

        return self.with_fields(chosen)

    def where(self, mask: Tensor, other: Self) -> Self:
        """Return this set where the mask ``(*batch,)`` is true and the other one elsewhere."""
        mine, theirs = self.fields(), other.fields()
        return type(self)(
            **{
                name: torch.where(mask[(...,) + (None,) * dims], mine[name], theirs[name])
                for name, dims in self.event_dims.items()
            },
            validate_args=False,
        )

    def unless_dropped(self, active: Tensor, center: Tensor, radius: Tensor) -> Self:
        """Return the set where it is active, and elsewhere one of its family that contains a ball.

        Args:
            active: Flags of the states in which the set stays, boolean ``(*batch,)``.
            center: The center of the ball, ``(*batch, d)``.
            radius: The radius of the ball, ``(*batch,)``.
        """
        return self.where(active, self.around(center, radius))

    def validate(self, name: str | None = None) -> Self:
        """Return the set itself, or refuse it. Compiled and exported programs check shapes alone.

        Args:
            name: The name of the constraint, for the message.

        Raises:
            GeometryError: naming constraint, field, batch index, the expected and the given.
        """
        kind = type(self).__name__
        where = f"constraint '{name}' ({kind})" if name else kind
        self.validate_shapes(where)
        if torch.compiler.is_compiling():
            return self
        for field, value in self.fields().items():
            self._refuse(where, field, torch.isnan(value), "a number")
            most = largest_value(self.dtype)
            huge = (value.abs() > most) & value.isfinite()
            self._refuse(where, field, huge, f"numbers up to {most:g}, the range of {self.dtype}")
            if field in self.finite_fields:
                self._refuse(where, field, value.isinf(), f"a finite {field}")
        for field, bad, expected in self.invalid_fields():
            self._refuse(where, field, bad, expected)
        return self

    def evidence(self) -> list[Evidence]:
        """Return numbers that are all within their limits if `validate` accepts the values.

        Reads nothing on the host: whoever does can read those of several sets together
        (`are_within`).
        """
        most = largest_value(self.dtype)
        found = []
        for field, value in self.fields().items():
            if field not in self.finite_fields:
                value = value.nan_to_num(nan=torch.inf, posinf=0, neginf=0)
            found += extremes(value, most)
        return found + [Evidence(mask.any(), 0) for _, mask, _ in self.invalid_fields()]

    def validate_shapes(self, where: str) -> None:
        """Refuse fields of wrong types or shapes, without reading their values.

        Args:
            where: The beginning of the message.

        Raises:
            GeometryError: naming the field, the expected and the given.
        """
        names = [field.name for field in dataclasses.fields(self)]
        event_dims = getattr(self, "event_dims", {})
        if set(event_dims) != set(names) or not any(event_dims.values()):
            raise GeometryError(
                f"{where}: expected event_dims with the number of event dimensions of each field, "
                f"{names}, at least one of them with the actions' d, given {event_dims}; decorate "
                "the family with @dataclass(frozen=True, eq=False)"
            )
        dtypes = {name: getattr(value, "dtype", None) for name, value in self.fields().items()}
        for name, value in self.fields().items():
            if not isinstance(value, Tensor) or value.dtype not in (torch.float32, torch.float64):
                given = dtypes[name] if isinstance(value, Tensor) else type(value).__name__
                raise GeometryError(
                    f"{where}, field '{name}': expected a float32 or float64 tensor, given "
                    f"{given}; convert it (half precision cannot hold a boundary with zero "
                    "tolerance)"
                )
            if value.ndim < self.event_dims[name]:
                raise GeometryError(
                    f"{where}, field '{name}': expected at least {self.event_dims[name]} "
                    f"dimensions (*batch, ...), given shape {tuple(value.shape)}"
                )
        if len(set(dtypes.values())) > 1:
            raise GeometryError(f"{where}: expected one dtype for all fields, given {dtypes}")
        widths = {
            n: int(v.shape[-1])
            for n, v in self.fields().items()
            if self.event_dims[n] > 0 and n not in self.fields_of_other_width()
        }
        if len(set(widths.values())) > 1 or 0 in widths.values():
            raise GeometryError(
                f"{where}: expected fields of one action dimension d >= 1, given last sizes "
                f"{widths}"
            )
        problem = self.shape_problem()
        if problem is not None:
            raise GeometryError(f"{where}: {problem}")
        try:
            _ = self.batch_shape
        except RuntimeError:
            shapes = {name: tuple(value.shape) for name, value in self.fields().items()}
            raise GeometryError(
                f"{where}: expected batch shapes that broadcast, given {shapes}"
            ) from None

    def shape_problem(self) -> str | None:
        """Return what is wrong with the event shapes beyond their dimension d, None if nothing."""
        return None

    @classmethod
    def fields_of_other_width(cls) -> frozenset[str]:
        """Return the fields whose last size is not the action dimension."""
        return frozenset()

    def _refuse(self, where: str, field: str, bad: Tensor, expected: str) -> None:
        if not bool(bad.any()):
            return
        index = tuple(int(i) for i in bad.nonzero()[0])
        value = getattr(self, field)
        given = value.expand(bad.shape)[index] if value.ndim <= bad.ndim else value[index]
        at = f" at index {list(index)}" if index else ""
        # Of a bound that is beyond the other one both matter.
        beside = "".join(
            f", {name} {other.expand(bad.shape)[index].tolist()}"
            for name, other in self.fields().items()
            if name != field and f" {name}" in expected and other.ndim <= bad.ndim
        )
        raise GeometryError(
            f"{where}, field '{field}'{at}: expected {expected}, given {given.tolist()}{beside}"
        )


def _gauge_at(sets: ConstraintSet, anchor: Tensor, direction: Tensor) -> Tensor:
    return sets.gauge(direction, anchor)
