"""The squash of the paper for each family of sets that has one."""

from __future__ import annotations

from collections.abc import Callable

from cnfp_torchrl.bijectors.ball_squash import BallSquash
from cnfp_torchrl.bijectors.bijector import Bijector
from cnfp_torchrl.bijectors.box_squash import BoxSquash
from cnfp_torchrl.bijectors.ellipsoid_squash import EllipsoidSquash
from cnfp_torchrl.geometry import Ball, Box, ConstraintSet, Ellipsoid

PAPER_SQUASHES: dict[type[ConstraintSet], Callable[..., Bijector]] = {
    Box: BoxSquash,
    Ball: BallSquash,
    Ellipsoid: EllipsoidSquash,
}
"""Families and their squashes, which take the family's fields; other families may be added."""


def paper_squash(constraint_set: ConstraintSet) -> Bijector:
    """Return the paper's analytic squash of R^d onto one set, without checking its fields.

    Raises:
        TypeError: when the family has none; `ExactSquash` handles every family.
    """
    # A plain look-up, because torch.compile cannot trace functools.singledispatch.
    squash = PAPER_SQUASHES.get(type(constraint_set))
    if squash is None:
        raise TypeError(
            "expected a set with a squash of its own, one of "
            f"{[family.__name__ for family in PAPER_SQUASHES]}, given "
            f"{type(constraint_set).__name__}; use the exact flow (flow=exact)"
        )
    return squash(**constraint_set.fields(), validate_args=False)
