"""The region of allowed actions in a state: an intersection of sets, with an anchor inside."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor

from cnfp_torchrl.geometry.box import ACTION_RANGE, Box, require_action_bounds
from cnfp_torchrl.geometry.constraint_set import ConstraintSet, GeometryError, broadcast_shape


class Region:
    """The intersection of the action bounds with K constraint sets, widened where they are relaxed.

    A set holds as stated where it is active. Elsewhere it is relaxed: each of its rows is widened
    by its relaxation. Where that is infinite or unknown it is dropped: it restricts nothing. A
    region never changes.

    Args:
        sets: K + 1 sets in order of application; ``sets[0]`` is the box of action bounds and always
            holds, the last has the highest priority.
        anchor: Points strictly inside all sets that are not dropped, ``(*batch, d)``; None where
            none is known, which all that takes gauges refuses.
        active: Flags of the sets that hold as stated, boolean ``(*batch, K + 1)``; None means all.
        relaxation: Amounts by which the m rows of each set are widened, ``(*batch, m)`` for each
            set, 0 where it is active, as `lexicographic_anchor` finds them. None means that all
            sets that are not active are dropped.
        validate_args: Whether to check shapes; no values are read.

    Raises:
        GeometryError: when the first set is not a box, or dimensions or the number of relaxations
            differ.
    """

    def __init__(
        self,
        sets: Sequence[ConstraintSet],
        anchor: Tensor | None = None,
        active: Tensor | None = None,
        relaxation: tuple[Tensor, ...] | None = None,
        *,
        validate_args: bool = True,
    ) -> None:
        self.sets = tuple(sets)
        self.active = active
        self.relaxation = relaxation
        self._anchor = anchor
        self._shape: torch.Size | None = None
        if validate_args:
            self._validate()

    def _validate(self) -> None:
        if not self.sets or not isinstance(self.sets[0], Box):
            given = [type(constraint_set).__name__ for constraint_set in self.sets]
            raise GeometryError(f"sets[0]: expected the Box of action bounds, given sets {given}")
        dims = [constraint_set.dim for constraint_set in self.sets]
        anchor_dim = dims[0] if self._anchor is None else int(self._anchor.shape[-1])
        if len({*dims, anchor_dim}) > 1:
            raise GeometryError(
                f"sets and anchor: expected one action dimension, given {dims} and {anchor_dim}"
            )
        if self.relaxation is not None and len(self.relaxation) != len(self.sets):
            raise GeometryError(
                f"relaxation: expected amounts for each of the {len(self.sets)} sets, bounds "
                f"included, given {len(self.relaxation)}"
            )

    @property
    def anchor(self) -> Tensor:
        """The points strictly inside that gauges are taken about, ``(*batch, d)``.

        Raises:
            GeometryError: when none is known.
        """
        if self._anchor is None:
            raise GeometryError(
                "anchor: expected a point strictly inside all sets, which gauges are taken about, "
                "given a region without one; find it with Region.build(sets)"
            )
        return self._anchor

    @property
    def has_anchor(self) -> bool:
        """Whether an anchor is known."""
        return self._anchor is not None

    @property
    def bounds(self) -> Box:
        """The action bounds, stage 0."""
        bounds = self.sets[0]
        assert isinstance(bounds, Box)
        return bounds

    @property
    def shape(self) -> torch.Size:
        """The shape ``(*batch, d)`` of the actions."""
        if self._shape is None:
            given = [value.shape[:-1] for value in (self._anchor, self.active) if value is not None]
            sets = (constraint_set.batch_shape for constraint_set in self.sets)
            self._shape = torch.Size((*broadcast_shape(*given, *sets), self.bounds.dim))
        return self._shape

    @property
    def is_active(self) -> Tensor:
        """The flags of `active`, boolean ``(*batch, K + 1)``, all true where that is None."""
        if self.active is not None:
            return self.active
        everywhere = (*self.shape[:-1], len(self.sets))
        return torch.ones(everywhere, dtype=torch.bool, device=self.bounds.low.device)

    def to(
        self, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> Self:
        """Return the region with sets and anchor in a dtype, all of it on a device."""
        sets = tuple(constraint_set.to(dtype, device) for constraint_set in self.sets)
        anchor = None if self._anchor is None else self._anchor.to(device, dtype)
        active = None if self.active is None else self.active.to(device)
        amounts = self.relaxation
        if amounts is not None:
            amounts = tuple(amount.to(device, dtype) for amount in amounts)
        return type(self)(sets, anchor, active, amounts, validate_args=False)

    def widened(self) -> tuple[ConstraintSet, ...]:
        """Return the sets, each widened by its relaxation; dropped ones as they are."""
        if self.relaxation is None:
            return self.sets
        return (
            self.bounds,
            *(
                constraint_set.inflated(amount)
                if constraint_set.can_be_inflated()
                else constraint_set
                for constraint_set, amount in zip(self.sets[1:], self.relaxation[1:], strict=True)
            ),
        )

    def amounts(self) -> Tensor:
        """Return by how much each set is relaxed, ``(*batch, K + 1)``.

        That of its largest row; 0 where it is active, infinite where it is dropped.
        """
        shape = self.shape[:-1]
        if self.relaxation is not None:
            largest = [amounts.amax(-1).expand(shape) for amounts in self.relaxation]
            return torch.stack(largest, -1)
        if self.active is None:
            return self.bounds.low.new_zeros(*shape, len(self.sets))
        dropped = self.bounds.low.new_full((), torch.inf)
        return torch.where(self.active, 0.0, dropped).expand(*shape, len(self.sets))

    def counts(self, stage: int) -> Tensor | None:
        """Return where a set is not dropped, boolean ``(*batch,)``; None means everywhere."""
        if stage == 0 or self.active is None:
            return None
        if self.relaxation is not None and self.sets[stage].can_be_inflated():
            return None
        return self.active[..., stage]

    def gauges(self, direction: Tensor) -> Tensor:
        """Return the gauge of the region after each stage, ``(K + 1, *batch)``.

        A running maximum over the sets, because the gauge of an intersection is the maximum of the
        gauges. A dropped set does not count.
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
        """Return the alpha projection of points ``(*batch, d)``.

        Points outside move towards the anchor, to where the ray from it leaves the region; points
        inside stay. To land in a region with zero tolerance, pull points into its `eroded` region.
        """
        offset = point - self.anchor
        direction, zero = scaled_direction(offset)
        # The gauge of the offset, not of the scaled direction; above 1 where the point is outside.
        _, inner = self.outer_and_inner_gauge(direction)
        gauge = inner * offset.detach().abs().amax(-1)
        share = torch.where(zero, 1.0, 1 / gauge.clamp(min=1))
        return self.anchor + share.unsqueeze(-1) * offset

    def contains(self, action: Tensor) -> Tensor:
        """Tell, with zero tolerance, whether each action lies in every set, relaxed or not."""
        inside = self.bounds.contains(action)
        for stage, constraint_set in enumerate(self.widened()[1:], 1):
            inside = inside & self._unless_dropped(stage, constraint_set.contains(action), True)
        return inside

    def slack(self, action: Tensor) -> Tensor:
        """Return the smallest slack in the sets, relaxed or not, ``(*batch,)``."""
        least = self.bounds.slack(action)
        for stage, constraint_set in enumerate(self.widened()[1:], 1):
            slack = self._unless_dropped(stage, constraint_set.slack(action), torch.inf)
            least = torch.minimum(least, slack)
        return least

    def eroded(self) -> Self:
        """Return the region whose points, computed in its dtype, lie in this one exactly.

        All sets of the result are active, so that nothing needs a mask and no gradient is NaN:
        relaxed sets are widened before they are eroded, and a dropped set is replaced by one of its
        family that reaches beyond the action bounds.

        Raises:
            GeometryError: when sets and anchor differ in dtype, because erosion by the rounding
                error of float64 vanishes in float32.
        """
        dtypes = [constraint_set.dtype for constraint_set in self.sets]
        if any(dtype != self.anchor.dtype for dtype in dtypes):
            raise GeometryError(
                f"sets and anchor: expected one dtype, given {dtypes} and {self.anchor.dtype}; "
                "convert them with .to(dtype)"
            )
        magnitude = self.bounds.magnitude()
        sets = [constraint_set.eroded(magnitude) for constraint_set in self.widened()]
        for stage in range(1, len(sets)):
            counts = self.counts(stage)
            if counts is not None:
                # Twice the largest distance between two points of the bounds.
                beyond = magnitude * (4 * self.anchor.shape[-1] ** 0.5)
                sets[stage] = sets[stage].unless_dropped(counts, self.anchor, beyond)
        return type(self)(tuple(sets), self.anchor, validate_args=False)

    def with_finite_bounds(self) -> Self:
        r"""Return the region with bounds no further from the anchor than its dtype resolves.

        Infinite bounds become finite ones, at :math:`2^{-13}/\epsilon` times the anchor's slack:
        1,024 times in float32 and 5e11 times in float64. Erosion by the rounding error of actions
        as large as that takes at most a few hundredths of the anchor's slack.
        """
        bounds, anchor = self.bounds, self.anchor
        reach = self.slack(anchor) / (2**13 * torch.finfo(anchor.dtype).eps)
        reach = reach.clamp(max=ACTION_RANGE[anchor.dtype][1] / 2).unsqueeze(-1)
        low = torch.where(bounds.low.isinf(), anchor - reach, bounds.low)
        high = torch.where(bounds.high.isinf(), anchor + reach, bounds.high)
        sets = (Box(low, high, validate_args=False), *self.sets[1:])
        return type(self)(sets, anchor, self.active, self.relaxation, validate_args=False)

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

        if len(sets) and isinstance(sets[0], Box):
            require_action_bounds(sets[0])
        found = lexicographic_anchor(sets, candidate, LEEWAY if leeway is None else leeway)
        return cls(tuple(sets), found.anchor, found.active, found.relaxation)

    def _gauges(self, direction: Tensor) -> list[Tensor]:
        gauges = [s.gauge(direction, self.anchor) for s in self.widened()]
        return [self._unless_dropped(stage, gauge, 0.0) for stage, gauge in enumerate(gauges)]

    def _unless_dropped(self, stage: int, value: Tensor, neutral: float | bool) -> Tensor:
        counts = self.counts(stage)
        return value if counts is None else torch.where(counts, value, neutral)


def scaled_direction(offset: Tensor) -> tuple[Tensor, Tensor]:
    """Return an offset scaled to a largest component of one, and whether it was as good as zero.

    The scale has no gradient, because ratios of gauges do not depend on it. In one dimension the
    direction has none either: it is a sign, and its exact gradient 0 would be computed as rounding
    error over length. An offset of zero gets an arbitrary direction, so that nothing becomes NaN;
    so does one shorter than 1e-19 in float32 or 1e-154 in float64, where gradients, which grow
    like 1/length, could overflow when squared.

    Args:
        offset: Points minus the anchor, ``(*batch, d)``.

    Returns:
        The direction ``(*batch, d)`` and the mask ``(*batch,)``.
    """
    length = offset.detach().abs().amax(-1, keepdim=True)
    zero = length < torch.finfo(offset.dtype).tiny ** 0.5
    if offset.shape[-1] == 1:
        offset = offset.detach()
    # Arithmetic, not torch.where, which is slow where the mask broadcasts.
    one = zero.to(offset.dtype)
    return (offset + one) / (length + one), zero.squeeze(-1)
