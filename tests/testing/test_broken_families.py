"""Broken families are caught, and the method that is wrong is named."""

from __future__ import annotations

import re

import pytest
import torch

from cnfp_torchrl.geometry import ConstraintSet, VisibleRegion
from cnfp_torchrl.testing import FamilyError, check_constraint_set
from tests.testing.broken import (
    BROKEN,
    AroundTooSmallIfLarge,
    CancelingGauge,
    GaugeAboutTheMiddle,
    PartThatIgnoresThePoint,
    PlainBall,
)

CENTER = torch.tensor([[3.0, -2.0, 0.5], [0.0, 0.25, -0.5], [0.5, 8.0, 0.125], [-1.0, 1.0, 2.0]])
RADIUS = torch.tensor([0.75, 0.5, 2.0, 1.25])
INSIDE = CENTER + torch.tensor([0.125, -0.25, 0.0625])


def test_the_family_that_they_break_is_right() -> None:
    for dtype in (torch.float32, torch.float64):
        check_constraint_set(PlainBall(CENTER.to(dtype), RADIUS.to(dtype)), INSIDE.to(dtype))


@pytest.mark.parametrize(("family", "method"), BROKEN, ids=lambda x: getattr(x, "__name__", x))
def test_the_wrong_method_is_named(family: type[ConstraintSet], method: str) -> None:
    sets = family(CENTER, RADIUS, validate_args=False)  # type: ignore[call-arg]
    with pytest.raises(FamilyError) as caught:
        check_constraint_set(sets, INSIDE)
    assert caught.value.method == method, str(caught.value)
    assert caught.value.family is family
    message = str(caught.value)
    assert message.startswith(f"{family.__name__}.{method}: ")
    assert "expected" in message
    assert "given" in message


def test_the_message_says_where() -> None:
    """It tells all that is needed to see the failure again."""
    sets = GaugeAboutTheMiddle(CENTER, RADIUS)
    with pytest.raises(FamilyError) as caught:
        check_constraint_set(sets, INSIDE)
    message = str(caught.value)
    assert "GaugeAboutTheMiddle.gauge: expected all before anchor + direction / gauge" in message
    numbers = {
        name: torch.tensor([float(x) for x in re.findall(r"[-+.\de]+", given)])
        for name, given in re.findall(r"\n    (\w+) = (.*)", message)
    }
    element = int(re.findall(r"element (\d) of", message)[0])
    torch.testing.assert_close(numbers["center"], CENTER[element])
    torch.testing.assert_close(numbers["radius"][0], RADIUS[element])
    torch.testing.assert_close(numbers["anchor"], INSIDE[element])
    action = (
        numbers["anchor"]
        + numbers["direction"] / sets.gauge(numbers["direction"], numbers["anchor"]).amax()
    )
    assert sets.select(RADIUS.shape, torch.tensor(element)).slack(action).abs() > 1e-3


def test_a_part_of_a_set_that_is_not_convex_has_to_heed_the_point() -> None:
    rectangle = torch.tensor([[[0.25, -0.5], [0.5, 0.125]]])
    seen = PartThatIgnoresThePoint(torch.zeros(2), rectangle, torch.tensor(1.0))
    with pytest.raises(FamilyError, match=r"PartThatIgnoresThePoint\.part_near: expected as much"):
        check_constraint_set(seen, torch.zeros(2))
    check_constraint_set(VisibleRegion(**seen.fields()), torch.zeros(2))


def test_a_batch_of_one_and_a_single_set_will_do() -> None:
    for sets, anchor in (
        (CancelingGauge(CENTER[:1], RADIUS[:1]), INSIDE[:1]),
        (CancelingGauge(CENTER[0], RADIUS[0]), INSIDE[0]),
        (CancelingGauge(torch.zeros(2), torch.tensor(1.0)), torch.zeros(2)),
    ):
        with pytest.raises(FamilyError, match=r"CancelingGauge\.gauge: expected a float32 exit"):
            check_constraint_set(sets, anchor)


def test_batch_elements_are_named_by_their_index() -> None:
    sets = AroundTooSmallIfLarge(CENTER.view(2, 2, 3), RADIUS.view(2, 2))
    with pytest.raises(FamilyError, match="element 2 of the flattened batch"):
        check_constraint_set(sets, INSIDE.view(2, 2, 3))
