"""What the checker asks of its example, and what it leaves alone."""

from __future__ import annotations

import inspect

import pytest
import torch

from cnfp_torchrl import testing
from cnfp_torchrl.geometry import Box
from cnfp_torchrl.testing import FamilyError, check_constraint_set, checker
from tests.testing.broken import CancelingGauge, PlainBall

BALL = PlainBall(torch.tensor([0.5, -0.25]), torch.tensor(0.75))
INSIDE = torch.tensor([0.25, 0.0])


def test_global_random_numbers_are_left_alone() -> None:
    before = torch.get_rng_state()
    check_constraint_set(BALL, INSIDE)
    assert torch.equal(torch.get_rng_state(), before)


def test_the_same_seed_finds_the_same() -> None:
    sets = CancelingGauge(**BALL.fields())
    messages = []
    for seed in (0, 0, 1):
        torch.rand(7)
        with pytest.raises(FamilyError) as caught:
            check_constraint_set(sets, INSIDE, seed=seed)
        messages.append(str(caught.value))
    assert messages[0] == messages[1] != messages[2]


def test_gradients_outside_do_not_matter() -> None:
    radius = torch.tensor(0.75, requires_grad=True)
    with torch.no_grad():
        check_constraint_set(PlainBall(BALL.center, radius), INSIDE)
    assert radius.grad is None


def test_an_anchor_outside_is_named() -> None:
    with pytest.raises(FamilyError, match=r"PlainBall\.slack: .*or an anchor inside the set"):
        check_constraint_set(BALL, torch.tensor([2.0, 0.0]))


def test_an_anchor_of_another_width_is_named() -> None:
    with pytest.raises(FamilyError, match="expected the anchor's action dimension, 3, given 2"):
        check_constraint_set(BALL, torch.zeros(3))


def test_an_anchor_of_another_dtype_is_refused() -> None:
    with pytest.raises(ValueError, match="anchor: expected the dtype of the sets"):
        check_constraint_set(BALL, INSIDE.double())


def test_bounds_have_to_be_finite_and_hold_the_anchor() -> None:
    for low, high in ((1.0, 2.0), (-1.0, torch.inf)):
        bounds = Box(low * torch.ones(2), high * torch.ones(2))
        with pytest.raises(ValueError, match="bounds: expected finite action bounds"):
            check_constraint_set(BALL, INSIDE, bounds=bounds)


def test_every_check_is_made_and_listed() -> None:
    made = {*checker.OF_SHAPES, *checker.ABOUT_THE_GIVEN_ANCHOR, *checker.ABOUT_ALL_ANCHORS}
    modules = (checker.shapes, checker.slacks, checker.gauges, checker.flows, checker.ranges)
    written = {
        function
        for module in modules
        for name, function in inspect.getmembers(module, inspect.isfunction)
        if name.startswith("check_") and function.__module__ == module.__name__
    }
    assert made == written
    for check in made:
        assert f"`{check.__name__}`" in testing.__doc__
