"""The squash of the paper for each family of sets that has one."""

from __future__ import annotations

from functools import singledispatch

from cnfp_torchrl.bijectors.ball_squash import BallSquash
from cnfp_torchrl.bijectors.bijector import Bijector
from cnfp_torchrl.bijectors.box_squash import BoxSquash
from cnfp_torchrl.bijectors.ellipsoid_squash import EllipsoidSquash
from cnfp_torchrl.geometry import Ball, Box, ConstraintSet, Ellipsoid


@singledispatch
def paper_squash(constraint_set: ConstraintSet) -> Bijector:
    """Return the paper's analytic squash of R^d onto one set, without checking its fields.

    Raises:
        TypeError: when the family has none; `GaugeSquash` handles every family.
    """
    known = [kind.__name__ for kind in paper_squash.registry if kind is not object]
    raise TypeError(
        f"expected a set with a squash of its own, one of {known}, given "
        f"{type(constraint_set).__name__}; use the exact flow (flow=exact)"
    )


@paper_squash.register
def _(constraint_set: Box) -> Bijector:
    return BoxSquash(constraint_set.low, constraint_set.high, validate_args=False)


@paper_squash.register
def _(constraint_set: Ball) -> Bijector:
    return BallSquash(constraint_set.center, constraint_set.radius, validate_args=False)


@paper_squash.register
def _(constraint_set: Ellipsoid) -> Bijector:
    return EllipsoidSquash(constraint_set.center, constraint_set.scale_tril, validate_args=False)
