"""The exact flow where boxes are retracted component by component and other sets radially."""

from __future__ import annotations

from collections.abc import Sequence

from cnfp_torchrl.bijectors.region_squash import RegionSquash
from cnfp_torchrl.geometry import Box, ConstraintSet


class ExactSquash(RegionSquash):
    r"""Squash R^d exactly onto the intersection of all active sets of a region.

    Stage 0 is the box squash into the action bounds B, :math:`x = \mathrm{BoxSquash}(z)`. Let c be
    the anchor, :math:`v = x - c`, and :math:`B_k` the intersection of B with the boxes among the
    first k constraints. What boxes forbid is taken out in each component on its own,

    .. math:: w_i = v_i\, \rho_i, \quad \rho_i = room_i(B_k) / room_i(B),

    with :math:`room_i` the distance from c to the side that :math:`v_i` points to, and what the
    other sets forbid along the ray: with :math:`G_k` the gauge of their intersection with
    :math:`B_k`, :math:`a_k = c + w/r`, :math:`r = G_k(w)/g_{B_k}(w)`. At the last stage
    :math:`\log|\det| = \log|\det \mathrm{BoxSquash}| + \sum_i \log \rho_i - d \log r`.

    A box beside the agent thus leaves the motion along it alone, which a retraction of the whole
    vector (`GaugeSquash`) shortens with the motion towards it. Without boxes among the constraints
    both are the same. The log-density jumps where a component of v changes its sign, and where
    other sets bind it has no limit at the anchor (`docs/method.md`). See `RegionSquash` for the
    arguments.
    """

    @staticmethod
    def boxes_and_others(
        sets: Sequence[ConstraintSet],
    ) -> tuple[Sequence[Box], Sequence[ConstraintSet]]:
        boxes = [each for each in sets if isinstance(each, Box)]
        return boxes, [each for each in sets if not isinstance(each, Box)]
