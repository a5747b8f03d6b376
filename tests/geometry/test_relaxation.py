"""What gives way where a constraint cannot be had: named cases, each with its right value."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cnfp_torchrl.bijectors import ExactSquash
from cnfp_torchrl.geometry import (
    LEEWAY,
    Anchored,
    Ball,
    Box,
    ConstraintSet,
    Ellipsoid,
    HalfSpaces,
    PositivePart,
    Region,
    TaskSpaceBall,
    VisibleRegion,
    WeightedL1Ball,
    lexicographic_anchor,
    relaxation_floor,
)
from tests.geometry.cases import BOUNDS, DTYPES, LEAST, t

MORE = 2 * LEEWAY
"""The leeway in these bounds."""


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def actions_of(sets: list[ConstraintSet], found: Anchored, count: int = 2000) -> Tensor:
    """Return what a policy of any kind does in one state, saturated ones among them."""
    bijector = ExactSquash(Region(tuple(sets), *found))
    scale = torch.logspace(-2, 6, count, dtype=found.anchor.dtype).unsqueeze(-1)
    return bijector(scale * torch.randn(count, found.anchor.shape[-1], dtype=found.anchor.dtype))


def kept(sets: list[ConstraintSet], found: Anchored, action: Tensor) -> bool:
    """Tell whether actions are in all sets, widened by no more than what is published."""
    for constraint_set, amount in zip(sets, found.relaxation, strict=True):
        slack = constraint_set.to(torch.float64).row_slacks(action.double())
        if not bool((slack >= -amount.double() * (1 + 1e-7)).all()):
            return False
    return True


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_spending_cap_of_nothing_spends_nothing(dtype: torch.dtype) -> None:
    for family in (PositivePart, WeightedL1Ball):
        cap = family(t(1.0, 2.0), number(0.0)).to(dtype)
        sets = [BOUNDS.to(dtype), cap]
        found = lexicographic_anchor(sets)
        action = actions_of(sets, found)
        assert kept(sets, found, action)
        assert found.active.tolist() == [True, False]
        spent = cap.slack(action).double() * -1
        assert spent.max() < 1.1 * (MORE + 2 * LEAST)
        assert (found.largest()[1] <= relaxation_floor(sets)[1]).all()


def test_free_components_of_a_cap_of_nothing_stay_free() -> None:
    sets = [BOUNDS, PositivePart(t(1.0, 0.0), number(0.0))]
    action = actions_of(sets, lexicographic_anchor(sets))
    assert action[:, 0].max() < 0.01
    assert action[:, 1].max() > 0.9
    sets = [BOUNDS, WeightedL1Ball(t(0.0, 0.0), number(0.0))]
    found = lexicographic_anchor(sets)
    assert found.active.all()
    assert actions_of(sets, found).isfinite().all()


@pytest.mark.parametrize("dtype", DTYPES)
def test_an_equality_as_two_half_spaces(dtype: torch.dtype) -> None:
    rows = HalfSpaces(t([1.0, 1.0], [-1.0, -1.0]), t(1.0, -1.0)).to(dtype)
    sets = [BOUNDS.to(dtype), rows]
    found = lexicographic_anchor(sets)
    action = actions_of(sets, found)
    assert kept(sets, found, action)
    # A distance, in the plane, of depth and leeway.
    assert (action.sum(-1) - 1).abs().max() < 1.1 * 2**0.5 * (MORE + 2 * LEAST)
    assert (found.largest()[1] <= relaxation_floor(sets)[1]).all()
    missed = [BOUNDS.to(dtype), HalfSpaces(t([1.0, 1.0], [-1.0, -1.0]), t(1.0, -1.01)).to(dtype)]
    assert (lexicographic_anchor(missed).largest()[1] > relaxation_floor(missed)[1]).all()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("speed", [3.0, 300.0])
def test_a_barrier_entered_too_fast_brakes_as_hard_as_it_can(
    speed: float, dtype: torch.dtype
) -> None:
    bounds = Box(t(-1.0), t(1.0)).to(dtype)
    barrier = HalfSpaces(t([1.0]), t(1.0 - speed)).to(dtype)
    sets = [bounds, barrier]
    found = lexicographic_anchor(sets)
    action = actions_of(sets, found)
    assert kept(sets, found, action)
    # What float32 knows of a far barrier is less, and so is what it can tell apart.
    deep = LEAST if dtype == torch.float64 else max(LEAST, 160 * 1.2e-7 * 2 * speed)
    assert action.max() < -1 + 1.1 * (MORE + 2 * deep)
    assert found.largest()[1] == pytest.approx(speed - 2 + MORE, abs=3 * deep)


def test_one_impossible_row_leaves_the_other_rows_alone() -> None:
    rows = HalfSpaces(t([-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]), t(-5.0, -0.3, 0.9))
    sets = [BOUNDS, rows]
    found = lexicographic_anchor(sets)
    amounts = found.relaxation[1]
    assert amounts[0].item() == pytest.approx(4 + 2 * LEAST + MORE, abs=0.1 * LEAST)
    assert amounts[1:].tolist() == [0.0, 0.0]
    action = actions_of(sets, found)
    assert kept(sets, found, action)
    assert action[:, 1].max() <= -0.3
    # The same for the sides of a box, one of which is out of reach.
    sets = [BOUNDS, Box(t(3.0, -0.5), t(4.0, 0.2))]
    amounts = lexicographic_anchor(sets).relaxation[1]
    assert (amounts > 0).tolist() == [False, False, True, False]


def test_the_worst_of_several_impossible_rows_does_not_set_the_others_amounts() -> None:
    rows = HalfSpaces(t([-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]), t(-5.0, 0.1, -0.5))
    amounts = lexicographic_anchor([BOUNDS, rows]).relaxation[1]
    # a_0 >= 5 misses by 4; a_1 <= .1 and a_1 >= .5 meet in the middle, each .2 off.
    expected = t(4 + 2 * LEAST, 0.2 + LEAST, 0.2 + LEAST) + MORE
    torch.testing.assert_close(amounts, expected, rtol=0, atol=0.1 * LEAST)


def test_rows_that_miss_by_the_same_at_some_point_do_not_share_an_amount() -> None:
    """From the middle both rows miss by 2 where the first one is nearest; the second can do 1."""
    rows = HalfSpaces(t([1.0, 0.0], [0.0, 1.0]), t(-3.0, -2.0))
    amounts = lexicographic_anchor([BOUNDS, rows]).relaxation[1]
    expected = t(2.0, 1.0) + 2 * LEAST + MORE
    torch.testing.assert_close(amounts, expected, rtol=0, atol=0.1 * LEAST)


def test_depth_is_left_however_many_sets_give_way() -> None:
    """The example of a rule that minimizes over the region itself, and is left without one."""
    sets = [BOUNDS, HalfSpaces(t([0.0, -1.0]), t(-5.0)), HalfSpaces(t([-1.0, 0.0]), t(-5.0))]
    sets.append(Ball(t(0.0, 0.0), number(1.0)))
    found = lexicographic_anchor(sets)
    assert found.active.tolist() == [True, False, False, True]
    assert Region(tuple(sets), *found).slack(found.anchor) > LEAST
    amounts = found.largest()
    assert amounts[2].item() == pytest.approx(4 + 2 * LEAST + MORE, abs=0.1 * LEAST)
    # Where a_0 >= 1 - 2 depths - leeway is left, the ball lets a_1 go up to its square root.
    high = ((1 - LEAST) ** 2 - (1 - LEAST - MORE) ** 2) ** 0.5
    assert amounts[1].item() == pytest.approx(5 + LEAST - high + MORE, rel=1e-3)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("unit", [1e-6, 1e-4, 1.0, 1e3, 1e6])
def test_actions_of_any_unit_behave_alike(unit: float, dtype: torch.dtype) -> None:
    for make in (
        lambda u: [Ball(t(9.0, 1.0) * u, number(0.5) * u)],
        lambda u: [HalfSpaces(t([1.0, 1.0], [-1.0, -1.0]), t(1.0, -1.0) * u)],
        lambda u: [
            Ellipsoid(t(0.5, 0.5) * u, t([0.3, 0.0], [0.1, 0.2]) * u),
            Ball(t(0.0, 0.0), number(0.6) * u),
        ],
        lambda u: [
            PositivePart(t(1.0, 2.0), number(0.0)),
            TaskSpaceBall(t([1.0, 2.0]), t(-2.5) * u, number(0.1) * u),
        ],
        lambda u: [Box(t(-0.2, 0.9) * u, t(0.1, 1.2) * u), HalfSpaces(t([0.0, 1.0]), t(0.5) * u)],
    ):
        bounds = [Box(BOUNDS.low * u, BOUNDS.high * u) for u in (1.0, unit)]
        base, scaled = (
            [constraint_set.to(dtype) for constraint_set in (box, *make(u))]
            for box, u in zip(bounds, (1.0, unit), strict=True)
        )
        expected, found = lexicographic_anchor(base), lexicographic_anchor(scaled)
        assert found.active.tolist() == expected.active.tolist()
        torch.testing.assert_close(
            found.largest() / unit, expected.largest(), rtol=1e-3, atol=0.1 * LEAST
        )
        assert kept(scaled, found, actions_of(scaled, found))


@pytest.mark.parametrize("dtype", DTYPES)
def test_narrow_wide_and_one_sided_bounds(dtype: torch.dtype) -> None:
    for low, high in ((-1e-4, 1e-4), (0.0, 1e5), (-1e-6, 1e-6), (1.0, 1.001)):
        size, middle = high - low, (low + high) / 2
        bounds = Box(t(low, low), t(high, high)).to(dtype)
        inside = Ball(t(middle, middle), number(0.3 * size)).to(dtype)
        beyond = HalfSpaces(t([-1.0, 0.0]), t(-high - size)).to(dtype)
        for sets, holds in (([bounds, inside], True), ([bounds, beyond], False)):
            found = lexicographic_anchor(sets)
            assert found.active.tolist() == [True, holds]
            action = actions_of(sets, found)
            assert bounds.contains(action).all()
            assert kept(sets, found, action)
        # Of narrow bounds far from 0 float32 knows little.
        assert action[:, 0].min() > high - 0.1 * size


def test_thin_ellipsoids_that_can_hold_do() -> None:
    for thin in (1e-2, 1e-3, 2e-4):
        tril = t([0.5, 0.0], [0.45, thin])
        sets = [BOUNDS, Ellipsoid(t(0.2, 0.1), tril)]
        found = lexicographic_anchor(sets)
        assert found.active.all()
        assert kept(sets, found, actions_of(sets, found))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("distance", [1e9, 1e18, 1e25])
def test_sets_at_any_distance_give_way(distance: float, dtype: torch.dtype) -> None:
    if dtype == torch.float32 and distance > 1e18:
        pytest.skip("squares leave the range of float32")
    center = t([distance, 0.0], [0.0, -distance], [0.3, 0.2])
    balls = Ball(center, number(0.5)).to(dtype)
    rows = HalfSpaces(t([1.0, 0.0]), -t([distance], [-1.0], [0.0])).to(dtype)
    for constraint_set in (balls, rows):
        sets = [BOUNDS.to(dtype), constraint_set]
        found = lexicographic_anchor(sets)
        assert found.anchor.isfinite().all()
        assert found.active[..., 1].tolist() == [False, constraint_set is rows, True]
        assert found.largest()[0, 1].item() == pytest.approx(distance, rel=1e-3)
        bijector = ExactSquash(Region(tuple(sets), *found))
        action, log_det = bijector.forward_and_log_det(torch.randn(50, 3, 2).to(dtype))
        assert BOUNDS.contains(action).all()
        assert log_det.isfinite().all()


def test_what_cannot_be_widened_is_dropped() -> None:
    hidden = VisibleRegion(t(0.0, 0.0), t([[-0.1, -0.1], [0.1, 0.1]]), number(0.1))
    sets = [BOUNDS, Ball(t(3.0, 0.0), number(0.5)), hidden]
    found = lexicographic_anchor(sets)
    assert found.active.tolist() == [True, False, False]
    assert found.largest().isinf().tolist() == [False, False, True]
    assert actions_of(sets, found).isfinite().all()
    assert found.anchor[0] > 0.99


def test_leeway_is_asked_for() -> None:
    with pytest.raises(ValueError, match="leeway: expected a number > 0, given 0"):
        lexicographic_anchor([BOUNDS], leeway=0)
    sets = [BOUNDS, Ball(t(3.0, 0.0), number(0.5))]
    narrow, wide = (lexicographic_anchor(sets, leeway=leeway) for leeway in (1e-5, 1e-2))
    added = (wide.largest() - narrow.largest())[1].item()
    assert added == pytest.approx(2 * (1e-2 - 1e-5), abs=0.1 * LEAST)


@pytest.mark.parametrize("relaxed", ["row", "point", "two"])
def test_gradients_and_densities_stay_bounded(relaxed: str) -> None:
    sets: list[ConstraintSet] = {
        "row": [BOUNDS, HalfSpaces(t([-1.0, -0.5]), t(-5.0))],
        "point": [BOUNDS, Ball(t(0.3, 0.2), number(0.0))],
        "two": [BOUNDS, Ball(t(-3.0, 0.0), number(1.0)), HalfSpaces(t([-1.0, 0.0]), t(-5.0))],
    }[relaxed]
    bijector = ExactSquash(Region(tuple(sets), *lexicographic_anchor(sets)))
    mean = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    noise = torch.randn(4000, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    action, log_det = bijector.forward_and_log_det(mean + noise)
    # d log(1/h) at the most, of a region of a thousandth of the bounds: what alpha has to weigh.
    assert -2 * 9 < log_det.mean() < 0
    gradients = torch.autograd.grad(action.sum(), mean)[0] / len(noise)
    assert gradients.abs().max() < 2
    assert (
        torch.autograd.grad(bijector.forward_and_log_det(mean + noise)[1].mean(), mean)[0]
        .abs()
        .max()
        < 20
    )
