"""What is refused, and that the message names the field, what was expected and what was given."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest
import torch

from cnfp_torchrl.bijectors import (
    BallSquash,
    Bijector,
    BoxSquash,
    EllipsoidSquash,
    ExactSquash,
    GaugeSquash,
    Projection,
    RadialSquash,
    Retraction,
    ShellSquash,
    SquashChain,
    paper_squash,
)
from cnfp_torchrl.geometry import Ball, Box, GeometryError, HalfSpaces, Region

ONE, ZERO = torch.ones(2), torch.zeros(2)
BOX = Box(-ONE, ONE)


def projection(region: Region) -> Bijector:
    return Projection(region, rounds=1)


def shell(region: Region) -> Bijector:
    radius = region.bounds.low.new_tensor(1.0)
    return ShellSquash(region.anchor, radius / 2, radius, region)


def unchecked_region(low: torch.Tensor, high: torch.Tensor) -> Region:
    return Region((Box(low, high, validate_args=False),), ZERO)


# All that sets refuse stands in tests/geometry/test_validation.py; here one of each kind, and what
# squashes need beyond that.
REFUSED = {
    "low above high": (
        lambda: BoxSquash(torch.tensor([0.0, 2.0]), torch.tensor([1.0, 1.0])),
        "field 'low' at index [1]: expected low <= high",
    ),
    "low equal to high": (lambda: BoxSquash(ONE, ONE), "expected low < high, given low 1.0"),
    "unbounded": (lambda: BoxSquash(ZERO, ONE * torch.inf), "BoxSquash: expected finite bounds"),
    "thin box": (
        lambda: BoxSquash(1000 * ONE, torch.tensor([1001.0, 1000.001])),
        "bounds further apart than rounding error in torch.float32",
    ),
    "region of two precisions": (
        lambda: GaugeSquash(Region((BOX, Ball(ZERO.double(), ONE[0].double())), ZERO)),
        "sets and anchor: expected one dtype, given [torch.float32, torch.float64] and torch.float",
    ),
    "negative radius": (
        lambda: BallSquash(ZERO, torch.tensor(-0.5)),
        "field 'radius': expected a finite radius >= 0, given -0.5",
    ),
    "zero radius in a batch": (
        lambda: BallSquash(torch.zeros(3, 2), torch.tensor([1.0, 0.0, 1.0])),
        "BallSquash: expected a radius above rounding error in torch.float32",
    ),
    "ball below resolution": (
        lambda: BallSquash(1000 * ONE, torch.tensor(1e-3)),
        "expected a radius above rounding error in torch.float32, given radius",
    ),
    "upper triangle": (
        lambda: EllipsoidSquash(ZERO, torch.ones(2, 2)),
        "field 'scale_tril' at index [0, 1]: expected zeros above the diagonal, given 1.0",
    ),
    "ellipsoid below resolution": (
        lambda: EllipsoidSquash(1000 * ONE, 1e-3 * torch.eye(2)),
        "expected an ellipsoid wider than rounding error in torch.float32",
    ),
    "bounds that were never checked": (
        lambda: GaugeSquash(unchecked_region(ONE, -ONE)),
        "expected low < high, given low 1.0",
    ),
}


WORTHLESS_BOUNDS = {
    "closer than rounding": (torch.float32, 1e6, 1e6 + 1),
    "closer than rounding in float64": (torch.float64, 1e15, 1e15 + 1),
    "beyond what can be squared": (torch.float32, -1e19, 1e19),
    "beyond what can be squared in float64": (torch.float64, 0.0, 1e160),
    "too close for squares": (torch.float32, -1e-20, 1e-20),
    "open": (torch.float32, -torch.inf, 1.0),
    "unbounded": (torch.float64, -torch.inf, torch.inf),
}


@pytest.mark.parametrize("build", [ExactSquash, GaugeSquash, RadialSquash, projection, shell])
@pytest.mark.parametrize("name", WORTHLESS_BOUNDS)
def test_bounds_that_no_flow_can_fill_are_refused(
    name: str, build: Callable[[Region], Bijector]
) -> None:
    dtype, low, high = WORTHLESS_BOUNDS[name]
    bounds = Box(ONE.to(dtype) * low, ONE.to(dtype) * high, validate_args=False)
    with pytest.raises(GeometryError, match="bounds"):
        build(Region((bounds,), ZERO.to(dtype)))
    with pytest.raises(GeometryError, match="bounds"):
        Region.build([bounds])
    with pytest.raises(GeometryError, match="Box"):
        BoxSquash(bounds.low, bounds.high)


@pytest.mark.parametrize("name", REFUSED)
def test_bad_input_is_refused(name: str) -> None:
    build, message = REFUSED[name]
    with pytest.raises(GeometryError, match=re.escape(message)):
        build()


def test_empty_chain_is_refused() -> None:
    with pytest.raises(ValueError, match="bijectors: expected at least one, given an empty chain"):
        SquashChain([])


def test_family_without_a_squash_is_refused() -> None:
    half_space = HalfSpaces(torch.ones(1, 2), torch.ones(1))
    with pytest.raises(TypeError, match=r"one of \['Box', 'Ball', 'Ellipsoid'\], given HalfSpaces"):
        paper_squash(half_space)


def test_checks_can_be_left_out() -> None:
    """Where values were checked before: in the compiled path nothing reads them on the host."""
    BoxSquash(ONE, -ONE, validate_args=False)
    BallSquash(ZERO, torch.tensor(-1.0), validate_args=False)
    EllipsoidSquash(ZERO, -torch.eye(2), validate_args=False)
    GaugeSquash(unchecked_region(ONE, -ONE), validate_args=False)
    Retraction(BOX, Ball(ZERO, torch.tensor(0.5)), ZERO)


@pytest.mark.parametrize("kind", [GaugeSquash, RadialSquash])
def test_a_broken_constraint_is_not_ignored(kind: type[GaugeSquash] | type[RadialSquash]) -> None:
    """Unchecked NaN comes out as NaN, which environments refuse; not as an unconstrained action."""
    broken = Ball(ZERO, torch.tensor(torch.nan), validate_args=False)
    bijector = kind(Region((BOX, broken), ZERO))
    for latent in (torch.tensor([0.3, -0.2]), 1e6 * ONE):
        action, log_det = bijector.forward_and_log_det(latent)
        assert action.isnan().all()
        assert log_det.isnan().all()
