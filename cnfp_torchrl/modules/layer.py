"""A last layer for networks of any kind: allowed actions out of any output, differentiably."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from cnfp_torchrl.geometry import ConstraintSet, GeometryError, Region
from cnfp_torchrl.modules.flows import Flow, resolve_flow

ROOM = 0.1
"""The share of the way from a region's anchor to its boundary that is left behind a new anchor."""


class ConstraintLayer(nn.Module):
    """Map a network's output to an allowed action: plain tensors in and out, differentiable.

    The output is a wished action, of any size. What comes out lies in every set of the region with
    zero tolerance, is a bijective function of the output, and is nearly the output where that is
    allowed already. Gradients reach the output, the nominal action and the fields of the sets, so
    that a control loop can be trained end to end. The layer has no parameters.

    Args:
        flow: The flow, or its name: one that takes wished actions, ``soft`` or ``recession``.
        room: The share, in (0, 1), of the way from the region's anchor to its boundary that is kept
            between the boundary and the anchor that a nominal action moves.

    Raises:
        ValueError: for another flow, or a room out of range.
    """

    def __init__(self, flow: Flow | str = "soft", *, room: float = ROOM) -> None:
        super().__init__()
        self.flow = resolve_flow(flow)
        if not self.flow.takes_actions:
            raise ValueError(
                f"flow: expected one that takes wished actions, 'soft' or 'recession', given "
                f"{type(self.flow).__name__}, which squashes all of R^d"
            )
        if not 0 < room < 1:
            raise ValueError(f"room: expected a number between 0 and 1, given {room}")
        self.room = room

    def forward(
        self,
        output: Tensor,
        region: Region | Sequence[ConstraintSet],
        nominal: Tensor | None = None,
    ) -> Tensor:
        """Return the allowed actions, ``(*batch, d)``.

        Args:
            output: Wished actions ``(*batch, d)``; with a nominal action the corrections to it.
            region: The regions of allowed actions; or their sets, the box of action bounds first,
                whose anchor is then searched for, if the flow needs one.
            nominal: Actions of a controller of one's own, ``(*batch, d)``. It stays as it is where
                it is allowed and the correction is 0: ``soft`` takes its gauges about the nominal
                action, or where that is closer to the boundary than ``room`` about the last point
                before on the way there.

        Raises:
            GeometryError: when the output differs from the region in dimension or dtype, or the
                region needs an anchor and has none.
        """
        if not isinstance(region, Region):
            needs = self.flow.needs_anchor(region)
            region = Region.build(region) if needs else Region(region)
        for name, given in (("output", output), ("nominal", nominal)):
            if given is not None:
                _refuse_misfit(name, given, region)
        if nominal is None:
            return self.flow.of_actions(region)(output)
        if self.flow.moves_with_anchor:
            region = about(region, nominal, self.room)
        return self.flow.of_actions(region)(nominal + output)

    def extra_repr(self) -> str:
        return f"flow={type(self.flow).__name__}"


def about(region: Region, action: Tensor, room: float) -> Region:
    """Return a region with its anchor moved to an action, or towards it as far as there is room.

    Args:
        region: Regions of convex sets.
        action: Actions ``(*batch, d)``, allowed or not.
        room: The share of the way from the old anchor to the boundary that is kept before it.
    """
    region = region.with_finite_bounds().eroded()
    offset = action - region.anchor
    gauge = _gauge(region, offset)
    share = 1 / torch.maximum(gauge / (1 - room), torch.ones_like(gauge))
    anchor = region.anchor + share.unsqueeze(-1) * offset
    return Region(region.sets, anchor, validate_args=False)


def _gauge(region: Region, offset: Tensor) -> Tensor:
    """Return the gauge at an offset of any size, 0 for 0."""
    length = offset.detach().abs().amax(-1, keepdim=True)
    one = (length == 0).to(offset.dtype)
    gauge = region.gauges((offset + one) / (length + one))[-1]
    return gauge * length.squeeze(-1)


def _refuse_misfit(name: str, given: Tensor, region: Region) -> None:
    dim, dtype = region.bounds.dim, region.bounds.dtype
    if given.ndim == 0 or given.shape[-1] != dim or given.dtype != dtype:
        raise GeometryError(
            f"{name}: expected a tensor (*batch, {dim}) of {dtype}, as the sets are, given "
            f"{tuple(given.shape)} of {given.dtype}"
        )
