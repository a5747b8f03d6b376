"""The measure of what a flow does to actions that were allowed already."""

from __future__ import annotations

import math

import pytest
import torch

from cnfp_torchrl.audit import measure_distortion
from cnfp_torchrl.geometry import Ball, Box, Region
from cnfp_torchrl.modules import (
    ExactFlow,
    Flow,
    GaugeFlow,
    ProjectionFlow,
    RadialFlow,
    SoftFlow,
)

DIVISOR = 8.0


def small_balls(count: int = 20) -> Region:
    """Balls of radius 1/8 about anchors in the middle of the bounds of a circle's square."""
    ones, anchor = torch.ones(2), torch.zeros(count, 2)
    return Region((Box(-ones, ones), Ball(anchor, torch.full((count,), 1 / DIVISOR))), anchor)


def test_a_hard_retraction_divides_by_the_divisor() -> None:
    """Of a ray of 1 to sqrt(2) that is cut at 1/8 the flow makes an eighth, or less."""
    torch.manual_seed(0)
    found = measure_distortion(GaugeFlow(), small_balls(), 100)
    # An action at a share q of the way becomes one at q/r.
    assert 0 < found.moved["min"] < found.moved["max"] < 1 - 1 / (math.sqrt(2) * DIVISOR) + 1e-6
    assert found.smallest["min"] > 0.5 / (math.sqrt(2) * DIVISOR)
    assert found.largest["max"] < 1.1
    assert found.on_boundary.share == 0


def test_a_soft_one_moves_by_its_formula() -> None:
    torch.manual_seed(0)
    found = measure_distortion(SoftFlow(2.0), small_balls(), 200)
    # At the boundary u is 2 - 1/r^2, where it moves most: 1 - u^(-1/2) of the ray.
    most = 1 - (2 - 1 / DIVISOR**2 / 2) ** -0.5
    assert 0.9 * most < found.moved["max"] < 1.01 * most
    # The slope along the ray is u^(-3/2) there, and never more than 1 anywhere.
    assert found.smallest["min"] == pytest.approx(2**-1.5, rel=0.05)
    assert found.largest["max"] < 1 + 1e-6


@pytest.mark.parametrize(("flow", "moves"), [(ProjectionFlow(), False), (RadialFlow(), True)])
def test_projection_leaves_allowed_actions_and_fills_the_boundary(flow: Flow, moves: bool) -> None:
    torch.manual_seed(0)
    found = measure_distortion(flow, small_balls(), 50)
    assert (found.moved["max"] > 1e-3) == moves
    assert (found.on_boundary.share > 0.5) == (not moves)


def test_what_does_not_bind_moves_nothing() -> None:
    ones, anchor = torch.ones(3), torch.full((5, 3), 0.2)
    region = Region((Box(-ones, ones), Ball(anchor, torch.full((5,), 9.0))), anchor)
    for flow in (ExactFlow(), SoftFlow()):
        found = measure_distortion(flow, region, 50)
        assert found.moved["max"] < 1e-5
        assert found.smallest["min"] == pytest.approx(1, abs=1e-5)
        assert found.largest["max"] == pytest.approx(1, abs=1e-5)
