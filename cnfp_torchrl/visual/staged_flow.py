"""A flow in one state with all its stages, mapped in one pass where the flow allows it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from cnfp_torchrl.bijectors import Bijector
from cnfp_torchrl.bijectors.bijector import Stages
from cnfp_torchrl.geometry import Region
from cnfp_torchrl.modules import Flow


class StagedFlow:
    """The bijectors of a flow up to each of its stages.

    Args:
        flow: how the sets are combined.
        region: of one state.
        applied: for each stage, indices into the region's sets of those applied so far.
    """

    def __init__(self, flow: Flow, region: Region, applied: Sequence[Sequence[int]]) -> None:
        self._count = len(applied)
        self._is_one = flow.is_safe and flow.has_density
        self._bijectors: list[Bijector]
        if self._is_one:
            # To an exact flow, a set not yet applied is one that is not active.
            holds = torch.tensor(
                [[k in each for k in range(len(region.sets))] for each in applied],
                device=region.anchor.device,
            )
            active = holds if region.active is None else holds & region.active
            stages = flow(region.bounds, region.sets[1:], region.anchor, active.unsqueeze(1))
            self._bijectors = [stages]
        else:
            self._bijectors = [stage_bijector(flow, region, each) for each in applied]

    @property
    def last(self) -> Bijector:
        """The bijector up to the last stage, of an exact flow all of them at once."""
        return self._bijectors[-1]

    def forward(self, latents: Tensor) -> Stages:
        """Return the actions of latents ``(n, d)`` after each stage, ``(stages, n, d)``."""
        if self._is_one:
            return self._each_stage(*self.last.forward_and_log_det(latents))
        return self.last.stages(latents)

    def inverse(self, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return latents ``(stages, n, d)`` that become actions ``(n, d)``, and log-determinants.

        The log-determinants ``(stages, n)`` are those of the maps from actions to latents.
        """
        if self._is_one:
            return self._each_stage(*self.last.inverse_and_log_det(actions))
        found = [each.inverse_and_log_det(actions) for each in self._bijectors]
        latents, log_dets = zip(*found, strict=True)
        return torch.stack(latents), torch.stack(log_dets)

    def _each_stage(self, points: Tensor, log_dets: Tensor) -> Stages:
        # What no constraint has a part in has no stages of its own.
        shape = (self._count, *points.shape[-2:])
        return Stages(points.expand(shape), log_dets.expand(shape[:-1]))


def stage_bijector(flow: Flow, region: Region, applied: Sequence[int]) -> Bijector:
    """Return the bijector of a flow up to a stage.

    Args:
        flow: how the sets are combined.
        region: of one state.
        applied: indices into the region's sets of those applied so far.
    """
    constraints = [k for k in applied if k > 0]
    sets = [region.sets[k] for k in constraints]
    active = None if region.active is None else region.active[..., [0, *constraints]]
    return flow(region.bounds, sets, region.anchor, active)
