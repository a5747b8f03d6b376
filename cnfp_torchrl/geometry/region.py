"""The region of allowed actions in a state: an intersection of sets, seen from one anchor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import InitVar, dataclass
from typing import Self

import torch
from torch import Tensor

from cnfp_torchrl.geometry.box import Box, require_action_bounds
from cnfp_torchrl.geometry.constraint_set import ConstraintSet, GeometryError, broadcast_shape


@dataclass(frozen=True, eq=False)
class Region:
    """The intersection of the action bounds with K constraint sets, widened where they are relaxed.

    A set holds as stated where it is active. Elsewhere it is widened by its relaxation, row by row,
    and adds nothing where that is infinite or unknown: there it is dropped.

    Args:
        sets: K + 1 sets in order of application; ``sets[0]`` is the box of action bounds and always
            holds, the last has the highest priority.
        anchor: a point strictly inside all sets that are not dropped, ``(*batch, d)``.
        active: which sets hold in which state, boolean ``(*batch, K + 1)``; None means all.
        relaxation: by how much the rows of each set are widened, ``(*batch, m)`` a set, as
            `lexicographic_anchor` finds it: 0 where the set is active. None means that all sets
            that are not active are dropped.

    Raises:
        GeometryError: when the first set is not a box, or dimensions or the number of relaxations
            differ.
    """

    sets: tuple[ConstraintSet, ...]
    anchor: Tensor
    active: Tensor | None = None
    relaxation: tuple[Tensor, ...] | None = None
    validate_args: InitVar[bool] = True

    def __post_init__(self, validate_args: bool) -> None:
        if not validate_args:
            return
        if not self.sets or not isinstance(self.sets[0], Box):
            given = [type(each).__name__ for each in self.sets]
            raise GeometryError(f"sets[0]: expected the Box of action bounds, given sets {given}")
        dims = [each.dim for each in self.sets] + [int(self.anchor.shape[-1])]
        if len(set(dims)) > 1:
            raise GeometryError(
                f"sets and anchor: expected one action dimension, given {dims[:-1]} and {dims[-1]}"
            )
        if self.relaxation is not None and len(self.relaxation) != len(self.sets):
            raise GeometryError(
                f"relaxation: expected amounts for each of the {len(self.sets)} sets, bounds "
                f"included, given {len(self.relaxation)}"
            )

    @property
    def bounds(self) -> Box:
        """The action bounds, stage 0."""
        bounds = self.sets[0]
        assert isinstance(bounds, Box)
        return bounds

    @property
    def shape(self) -> torch.Size:
        """The shape ``(*batch, d)`` of the actions."""
        active = () if self.active is None else (self.active.shape[:-1],)
        sets = (each.batch_shape for each in self.sets)
        batch = broadcast_shape(self.anchor.shape[:-1], *active, *sets)
        return torch.Size((*batch, self.anchor.shape[-1]))

    def to(
        self, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> Self:
        """Return the region with sets and anchor in a dtype, all of it on a device."""
        sets = tuple(each.to(dtype, device) for each in self.sets)
        active = None if self.active is None else self.active.to(device)
        amounts = self.relaxation
        if amounts is not None:
            amounts = tuple(each.to(device, dtype) for each in amounts)
        return type(self)(sets, self.anchor.to(device, dtype), active, amounts, validate_args=False)

    def widened(self) -> tuple[ConstraintSet, ...]:
        """Return the sets, each widened by its relaxation; dropped ones as they are."""
        if self.relaxation is None:
            return self.sets
        return (
            self.bounds,
            *(
                each.inflated(amount) if each.can_be_inflated() else each
                for each, amount in zip(self.sets[1:], self.relaxation[1:], strict=True)
            ),
        )

    def amounts(self) -> Tensor:
        """Return by how much each set is relaxed, ``(*batch, K + 1)``.

        That of its largest row; 0 where it is active, infinite where it is dropped.
        """
        shape = self.shape[:-1]
        if self.relaxation is not None:
            largest = [each.amax(-1).expand(shape) for each in self.relaxation]
            return torch.stack(largest, -1)
        if self.active is None:
            return self.anchor.new_zeros(*shape, len(self.sets))
        dropped = self.anchor.new_full((), torch.inf)
        return torch.where(self.active, 0.0, dropped).expand(*shape, len(self.sets))

    def counts(self, stage: int) -> Tensor | None:
        """Return where a set holds or is relaxed, boolean ``(*batch,)``; None means everywhere."""
        if stage == 0 or self.active is None:
            return None
        if self.relaxation is not None and self.sets[stage].can_be_inflated():
            return None
        return self.active[..., stage]

    def gauges(self, direction: Tensor) -> Tensor:
        """Return the gauge of the region after each stage, ``(K + 1, *batch)``.

        The gauge of an intersection is the maximum of the gauges, so this is a running maximum; a
        set that is dropped adds nothing.
        """
        running: list[Tensor] = []
        for gauge in self._gauges(direction):
            running.append(torch.maximum(running[-1], gauge) if running else gauge)
        return torch.stack(torch.broadcast_tensors(*running))

    def outer_and_inner_gauge(self, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gauges of the action bounds and of the whole region, each ``(*batch,)``."""
        outer, *others = self._gauges(direction)
        inner = outer
        for gauge in others:
            inner = torch.maximum(inner, gauge)
        return outer, inner

    def pulled_in(self, point: Tensor) -> Tensor:
        """Return points ``(*batch, d)`` moved towards the anchor where they lie outside.

        They end where the ray from the anchor leaves the region; points inside stay. Of an `eroded`
        region, so that the result lies in the region itself with zero tolerance. Known as alpha
        projection.
        """
        offset = point - self.anchor
        direction, zero = scaled_direction(offset)
        # The gauge of the offset itself; above 1 where it ends outside.
        _, inner = self.outer_and_inner_gauge(direction)
        gauge = inner * offset.detach().abs().amax(-1)
        share = torch.where(zero, 1.0, 1 / gauge.clamp(min=1))
        return self.anchor + share.unsqueeze(-1) * offset

    def contains(self, action: Tensor) -> Tensor:
        """Tell, with zero tolerance, whether each action lies in every set, relaxed or not."""
        inside = self.bounds.contains(action)
        for stage, each in enumerate(self.widened()[1:], 1):
            inside = inside & self._unless_dropped(stage, each.contains(action), True)
        return inside

    def slack(self, action: Tensor) -> Tensor:
        """Return the smallest slack in the sets, relaxed or not, ``(*batch,)``."""
        least = self.bounds.slack(action)
        for stage, each in enumerate(self.widened()[1:], 1):
            slack = self._unless_dropped(stage, each.slack(action), torch.inf)
            least = torch.minimum(least, slack)
        return least

    def eroded(self) -> Self:
        """Return the region whose points, computed in its dtype, lie in this one exactly.

        Relaxed sets are widened before. A dropped set is replaced by one of its family that reaches
        beyond the action bounds, so that all sets of the result are active: nothing needs a mask,
        and no gradient is NaN.

        Raises:
            GeometryError: when sets and anchor have several dtypes, in the coarser ones of which
                the erosion by the finer one's rounding error is none.
        """
        dtypes = [each.dtype for each in self.sets]
        if any(dtype != self.anchor.dtype for dtype in dtypes):
            raise GeometryError(
                f"sets and anchor: expected one dtype, given {dtypes} and {self.anchor.dtype}; "
                "convert them with .to(dtype)"
            )
        magnitude = self.bounds.magnitude()
        sets = [each.eroded(magnitude) for each in self.widened()]
        # No two points of the bounds are further apart than half of it.
        beyond = magnitude * (4 * self.anchor.shape[-1] ** 0.5)
        for stage in range(1, len(sets)):
            counts = self.counts(stage)
            if counts is not None:
                sets[stage] = sets[stage].unless_dropped(counts, self.anchor, beyond)
        return type(self)(tuple(sets), self.anchor, validate_args=False)

    @classmethod
    def build(
        cls,
        sets: Sequence[ConstraintSet],
        candidate: Tensor | None = None,
        leeway: float | None = None,
    ) -> Self:
        """Find anchor, active flags and relaxations by the lexicographic rule.

        See `cnfp_torchrl.geometry.lexicographic_anchor`, whose arguments these are.
        """
        from cnfp_torchrl.geometry.anchor import LEEWAY, lexicographic_anchor

        if sets and isinstance(sets[0], Box):
            require_action_bounds(sets[0])
        found = lexicographic_anchor(sets, candidate, LEEWAY if leeway is None else leeway)
        return cls(tuple(sets), found.anchor, found.active, found.relaxation)

    def _gauges(self, direction: Tensor) -> list[Tensor]:
        gauges = [each.gauge(direction, self.anchor) for each in self.widened()]
        return [self._unless_dropped(stage, gauge, 0.0) for stage, gauge in enumerate(gauges)]

    def _unless_dropped(self, stage: int, value: Tensor, neutral: float | bool) -> Tensor:
        counts = self.counts(stage)
        return value if counts is None else torch.where(counts, value, neutral)


def scaled_direction(offset: Tensor) -> tuple[Tensor, Tensor]:
    """Return an offset scaled to a largest component of one, and whether it was as good as zero.

    Ratios of gauges do not depend on the length of the direction, so the scale needs no gradient;
    in one dimension the direction is a sign and needs none either (its exact zero would come out as
    rounding error over length). An offset of zero, which has no direction, is given one, so that
    nothing becomes NaN; and so is one so short that gradients, which grow like 1/length, could
    overflow when squared (1e-19 in float32, 1e-154 in float64).

    Args:
        offset: a point minus the anchor, ``(*batch, d)``.

    Returns:
        The direction ``(*batch, d)`` and the mask ``(*batch,)``.
    """
    length = offset.detach().abs().amax(-1, keepdim=True)
    zero = length < torch.finfo(offset.dtype).tiny ** 0.5
    if offset.shape[-1] == 1:
        offset = offset.detach()
    # Arithmetic, because torch.where is slow where the mask broadcasts.
    one = zero.to(offset.dtype)
    return (offset + one) / (length + one), zero.squeeze(-1)
