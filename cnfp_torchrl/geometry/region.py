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
    """The intersection of the action bounds with the active ones of K constraint sets.

    Args:
        sets: K + 1 sets in order of application; ``sets[0]`` is the box of action bounds and always
            holds, the last has the highest priority.
        anchor: a point strictly inside all active sets, ``(*batch, d)``.
        active: which sets hold in which state, boolean ``(*batch, K + 1)``; None means all.

    Raises:
        GeometryError: when the first set is not a box or the dimensions differ.
    """

    sets: tuple[ConstraintSet, ...]
    anchor: Tensor
    active: Tensor | None = None
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
        return type(self)(sets, self.anchor.to(device, dtype), active, validate_args=False)

    def gauges(self, direction: Tensor) -> Tensor:
        """Return the gauge of the region after each stage, ``(K + 1, *batch)``.

        The gauge of an intersection is the maximum of the gauges, so this is a running maximum; a
        set that is not active adds nothing.
        """
        running = [self.sets[0].gauge(direction, self.anchor)]
        for stage in range(1, len(self.sets)):
            running.append(torch.maximum(running[-1], self._gauge(stage, direction)))
        return torch.stack(torch.broadcast_tensors(*running))

    def outer_and_inner_gauge(self, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gauges of the action bounds and of the whole region, each ``(*batch,)``."""
        outer = inner = self.sets[0].gauge(direction, self.anchor)
        for stage in range(1, len(self.sets)):
            inner = torch.maximum(inner, self._gauge(stage, direction))
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
        """Tell, with zero tolerance, whether each action lies in every active set."""
        inside = self.sets[0].contains(action)
        for stage in range(1, len(self.sets)):
            inside = inside & self._unless_dropped(stage, self.sets[stage].contains(action), True)
        return inside

    def slack(self, action: Tensor) -> Tensor:
        """Return the smallest slack of the active sets, ``(*batch,)``."""
        least = self.sets[0].slack(action)
        for stage in range(1, len(self.sets)):
            slack = self._unless_dropped(stage, self.sets[stage].slack(action), torch.inf)
            least = torch.minimum(least, slack)
        return least

    def eroded(self) -> Self:
        """Return the region whose points, computed in its dtype, lie in this one exactly.

        A dropped set is replaced by one of its family that reaches beyond the action bounds, so
        that all sets of the result are active: nothing needs a mask, and no gradient is NaN.

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
        sets = [each.eroded(magnitude) for each in self.sets]
        if self.active is not None:
            # No two points of the bounds are further apart than half of it.
            beyond = magnitude * (4 * self.anchor.shape[-1] ** 0.5)
            for stage in range(1, len(sets)):
                active = self.active[..., stage]
                sets[stage] = sets[stage].unless_dropped(active, self.anchor, beyond)
        return type(self)(tuple(sets), self.anchor, validate_args=False)

    @classmethod
    def build(cls, sets: Sequence[ConstraintSet], anchor: Tensor | None = None) -> Self:
        """Find anchor and active flags by the lexicographic rule, highest priority first.

        See `cnfp_torchrl.geometry.anchors.lexicographic_anchor`.
        """
        from cnfp_torchrl.geometry.anchors import lexicographic_anchor

        if sets and isinstance(sets[0], Box):
            require_action_bounds(sets[0])
        point, active = lexicographic_anchor(sets, anchor)
        return cls(tuple(sets), point, active)

    def _gauge(self, stage: int, direction: Tensor) -> Tensor:
        return self._unless_dropped(stage, self.sets[stage].gauge(direction, self.anchor), 0.0)

    def _unless_dropped(self, stage: int, value: Tensor, neutral: float | bool) -> Tensor:
        if self.active is None:
            return value
        return torch.where(self.active[..., stage], value, neutral)


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
