"""The exact flow with all retractions radial."""

from __future__ import annotations

from collections.abc import Sequence

from cnfp_torchrl.bijectors.region_squash import RegionSquash
from cnfp_torchrl.geometry import Box, ConstraintSet


class GaugeSquash(RegionSquash):
    r"""Squash R^d exactly onto the intersection of all active sets of a region, along rays.

    Stage 0 is the box squash into the action bounds, :math:`x = \mathrm{BoxSquash}(z)`. Each
    further stage retracts radially about the anchor c: with :math:`v = x - c`, :math:`g_0` the
    gauge of the bounds and :math:`G_k` that of the region after k constraints,
    :math:`a_k = c + v/r`, :math:`r = G_k(v)/g_0(v)`. At the last stage
    :math:`\log|\det| = \log|\det \mathrm{BoxSquash}| - d \log r`.

    Where nothing binds, r = 1 and the action is that of a tanh-squashed Gaussian. The log-density
    has no limit at the anchor, where its gradient grows like :math:`1/|v|` (`docs/method.md`). See
    `RegionSquash` for the arguments.
    """

    @staticmethod
    def boxes_and_others(
        sets: Sequence[ConstraintSet],
    ) -> tuple[Sequence[Box], Sequence[ConstraintSet]]:
        return (), sets
