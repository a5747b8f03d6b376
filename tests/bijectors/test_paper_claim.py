"""The paper's claim that its composed squashes stay in the intersection of all sets is false."""

from __future__ import annotations

import torch

from cnfp_torchrl.geometry import Ball, Box
from tests.bijectors.cases import BY_NAME, Case, Maker, latents, tensor


def share_outside(case: Case, stage: int) -> float:
    action = case.build(torch.float32)(latents(case, 20_000, torch.float32))
    return float((~case.allows_stage(stage, action)).double().mean())


def test_a_chain_of_squashes_leaves_its_first_set_and_the_exact_flow_does_not() -> None:
    ball = Ball(tensor(0.75, -0.75), tensor(0.5).squeeze())
    box = Box(tensor(-1.0, -1.0), tensor(1.0, 1.0))
    chain = Case("ball, then box", "chain", (ball, box))
    assert share_outside(chain, 0) > 0.05
    assert share_outside(chain, 1) == 0

    exact = Case("box, then ball", "gauge", (box, ball), tensor(0.625, -0.625))
    assert share_outside(exact, 0) == 0
    assert share_outside(exact, 1) == 0


def test_only_the_last_set_of_a_chain_is_guaranteed() -> None:
    chain = BY_NAME["box-ellipsoid-ball-d3-batch"]
    outside = [share_outside(chain, stage) for stage in range(3)]
    assert outside[0] > 0.05
    assert outside[2] == 0


def test_a_wide_ball_saturates_the_box_after_it() -> None:
    """With radius 40, nearly every action is a corner: the second failure of the composition."""
    make = Maker(2, seed=51)
    wide = make.ball(40.0)
    action = Case("", "chain", (wide, make.bounds())).build(torch.float32)(torch.randn(20_000, 2))
    at_bound = (action - make.low).abs().minimum((action - make.high).abs()) < 1e-5
    assert at_bound.double().mean() > 0.5
