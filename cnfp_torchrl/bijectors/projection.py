"""The projection baseline: the closest allowed action instead of a bijection."""

from __future__ import annotations

from typing import NoReturn

import torch
from torch import Tensor

from cnfp_torchrl.bijectors.bijector import Bijector, Stages
from cnfp_torchrl.bijectors.squashes import BoxSquash
from cnfp_torchrl.geometry import (
    Region,
    project_onto_intersection,
    require_action_bounds,
    settled,
)


class NoDensityError(NotImplementedError):
    """A density that does not exist; names the map and what to use instead."""


class Projection(Bijector):
    r"""Squash R^d into the action bounds, then take the closest point of the region.

    :math:`a = \arg\min_{a' \in S} |a' - \mathrm{BoxSquash}(z)|`, found by Dykstra's algorithm
    (`cnfp_torchrl.geometry.project_onto_intersection`). Where its rounds did not suffice the result
    is pulled towards the anchor, so that every action satisfies every active constraint with zero
    tolerance. Differentiable almost everywhere.

    This is no bijection, though it has a bijector's interface: everything outside the region lands
    on its boundary, whose points have positive probability and no density. Only the reference
    log-determinant exists, that of the squash into the bounds; it gives the entropy of the action
    before the projection.

    Args:
        region: Regions of batch shape ``(*batch,)``, of any shipped family.
        rounds: The number of rounds of Dykstra's algorithm, >= 1.
        validate_args: Whether to check the action bounds, which reads them on the host.

    Raises:
        ValueError: when there are no rounds.
        NoDensityError: when a density, an inverse or stages are asked for.
        TypeError: on mapping, for a set of a family that says neither how it projects nor how it is
            described (`ConstraintSet.superlevel`).
    """

    bijective = False

    def __init__(self, region: Region, *, rounds: int, validate_args: bool = True) -> None:
        super().__init__()
        if rounds < 1:
            raise ValueError(f"rounds: expected a number >= 1, given {rounds}")
        if validate_args:
            require_action_bounds(region.bounds)
        self._allowed, self._region = region, region.eroded()
        self._box = BoxSquash.onto(self._region.bounds)
        self._rounds = rounds

    @property
    def shape(self) -> torch.Size:
        return self._region.shape

    def forward_and_reference_log_det(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        bounded, log_det = self._box.forward_and_log_det(latent)
        closest = project_onto_intersection(self._region, bounded, self._rounds)
        return settled(self._region, closest), log_det

    def contains(self, action: Tensor) -> Tensor:
        """Tell whether each action lies in the region, whose boundary is part of the image."""
        return self._allowed.contains(action)

    def forward_and_log_det(self, latent: Tensor) -> NoReturn:
        raise _no_density("a log-determinant")

    def inverse_and_log_det(self, action: Tensor) -> NoReturn:
        raise _no_density("an inverse")

    def stages(self, latent: Tensor) -> Stages:
        raise _no_density("the densities of its stages")

    def _call(self, x: Tensor) -> Tensor:
        return self.forward_and_reference_log_det(x)[0]


def _no_density(wanted: str) -> NoDensityError:
    return NoDensityError(
        f"Projection: it has no density, hence not {wanted}, for it maps many samples to one "
        "action; learn with the reference entropy (loss.entropy=reference), or take a flow with a "
        "density (flow=exact)"
    )
