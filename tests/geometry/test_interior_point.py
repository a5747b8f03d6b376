"""The interior-point method: its bounds on the way, and what families tell it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cnfp_torchrl.geometry import (
    Ball,
    Box,
    ConstraintSet,
    Ellipsoid,
    HalfSpaces,
    PositivePart,
    WeightedL1Ball,
)
from cnfp_torchrl.geometry.anchor.closed_form import maximize_slack_over_box
from cnfp_torchrl.geometry.anchor.interior_point import ConeScaling, maximize_slack
from cnfp_torchrl.geometry.anchor.intersection import Intersection
from cnfp_torchrl.geometry.anchor.program import Array, Flags, Index, Program
from tests.geometry.cases import CASES, Case


def sets(dim: int) -> list[ConstraintSet]:
    """Return bounds and four sets, of batch shape (1,)."""
    ones = torch.ones(1, dim, dtype=torch.float64)
    tril = torch.randn(1, dim, dim, dtype=torch.float64).tril() * 0.2 + torch.eye(dim)
    return [
        Box(-ones, ones),
        WeightedL1Ball(torch.randn_like(ones), 0.7 * ones[:, 0]),
        PositivePart(torch.randn_like(ones), 0.3 * ones[:, 0]),
        Ball(torch.randn_like(ones), 1.2 * ones[:, 0]),
        Ellipsoid(torch.randn_like(ones), tril),
    ]


def program(chosen: list[ConstraintSet]) -> Program:
    """Return the problem of the most slack in all sets."""
    bounds = chosen[0]
    assert isinstance(bounds, Box)
    stacked = Program.stack(
        [part for constraint_set in chosen if (part := constraint_set.superlevel())], bounds
    )
    width = len(stacked.rows) - 2 * len(stacked.reach) + len(stacked.cones)
    every = np.ones((width, len(bounds.low)), dtype=bool)
    return stacked.requiring(0.0 * every, every, every)


def close(lower: Array, upper: Array, index: Index) -> Flags:
    """Tell where bounds are close."""
    return upper - lower <= 1e-7


@pytest.mark.parametrize("kinds", [(0,), (0, 3, 4), (0, 1), (0, 1, 2), (0, 1, 2, 3, 4)])
def test_bounds_hold_on_the_way_and_close_in(kinds: tuple[int, ...]) -> None:
    """At each step the lower bound is an action's slack, and no random action beats the upper."""
    dim = 4
    chosen = [constraint_set for i, constraint_set in enumerate(sets(dim)) if i in kinds]
    intersection = Intersection.of(chosen)
    start = 0.5 * torch.randn(1, dim).double().numpy()
    rows = np.ones((1, sum(intersection.widths)), dtype=bool)
    seen: list[tuple[float, float]] = []

    def watched(lower: Array, upper: Array, index: Index) -> Flags:
        seen.append((lower.item(), upper.item()))
        return close(lower, upper, index)

    best = intersection.maximize(0.0 * rows, rows, rows, start, watched)
    found = torch.from_numpy(best.action)
    slack = torch.stack([constraint_set.slack(found) for constraint_set in chosen]).amin()
    assert slack.item() == pytest.approx(best.slack.item(), abs=1e-7)
    around = found + torch.logspace(-6, 0, 5000).double().unsqueeze(-1) * torch.randn(5000, dim)
    reached = (
        torch.stack([constraint_set.slack(around) for constraint_set in chosen])
        .amin(0)
        .amax()
        .item()
    )
    assert all(reached <= upper for _, upper in seen)
    assert all(lower <= best.upper_bound.item() for lower, _ in seen)
    assert best.upper_bound.item() - best.slack.item() <= 1e-7
    # Newton's method, not bisection.
    assert len(seen) < 25


@pytest.mark.parametrize("dim", [4, 6])
def test_steps_do_not_go_round_in_circles(dim: int) -> None:
    """Towards ellipsoids near and beyond the boundary of a weighted L1 ball, all of 400."""
    batch, generator = 400, torch.Generator().manual_seed(dim)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(batch, *shape, generator=generator, dtype=torch.float64)

    ones = torch.ones(batch, dim, dtype=torch.float64)
    weights, center = normal(dim), 0.6 * normal(dim)
    reach = 1.1 ** normal() * (weights * center).abs().sum(-1)
    tril = 0.02 * normal(dim, dim).tril(-1) + torch.diag_embed(0.05 + 0.1 * normal(dim).abs())
    intersection = Intersection.of(
        [Box(-ones, ones), Ellipsoid(center, tril), WeightedL1Ball(weights, 0.8 * reach)]
    )
    counts = np.ones((batch, 2 * dim + 2), dtype=bool)
    maximized = counts & (np.arange(2 * dim + 2) == 2 * dim)
    asked = []

    def watched(lower: Array, upper: Array, index: Index) -> Flags:
        asked.append(len(index))
        return close(lower, upper, index)

    best = intersection.maximize(5e-5 * counts, maximized, counts, np.zeros((batch, dim)), watched)
    assert (best.upper_bound - best.slack).max() <= 1e-6
    assert (best.slack < 0).mean() > 0.5
    assert len(asked) < 25


def test_the_scaling_of_cones() -> None:
    """It makes slack and weight the same vector, and its two directions are inverse."""
    vectors = torch.randn(2, 3, 4, 5).double()
    vectors[:, :, 0] = vectors[:, :, 1:].norm(dim=2) * (1 + torch.rand(2, 3, 5)) + 1e-3
    slack, weight = vectors.numpy()
    scaling = ConeScaling.between(slack, weight)
    np.testing.assert_allclose(scaling.scaled(weight), scaling.unscaled(slack), rtol=1e-8)
    np.testing.assert_allclose(scaling.unscaled(scaling.scaled(slack)), slack, rtol=1e-8)


def test_rows_that_do_not_count_change_nothing() -> None:
    everything, chosen = sets(3), [True, False, True, False, True]
    kept = [constraint_set for constraint_set, on in zip(everything, chosen, strict=True) if on]
    results = []
    for some, counts in ((everything, chosen), (kept, [True] * 3)):
        intersection = Intersection.of(some)
        width = intersection.widths[0]
        on = np.array([[counts[0]] * width + counts[1:]])
        best = intersection.maximize(0.0 * on, on, on, np.zeros((1, 3)), close)
        slack = intersection.row_slacks(best.action)[on].min()
        results.append([slack, best.slack.item(), best.upper_bound.item()])
    np.testing.assert_allclose(results[0], results[1], rtol=1e-6, atol=1e-6)


def test_what_is_required_is_kept() -> None:
    """The ball's slack is the largest where the bounds' slack is what is required of them."""
    ones = torch.ones(1, 2, dtype=torch.float64)
    chosen = [Box(-ones, ones), Ball(3 * ones * torch.tensor([1.0, 0.0]), ones[:, 0])]
    intersection = Intersection.of(chosen)
    counts = np.ones((1, 5), dtype=bool)
    maximized = np.array([[False] * 4 + [True]])
    for least in (0.0, 0.1):
        required = np.array([[least] * 4 + [0.0]])
        best = intersection.maximize(required, maximized, counts, np.zeros((1, 2)), close)
        assert best.slack.item() == pytest.approx(-1 - least, abs=1e-6)
        np.testing.assert_allclose(best.action, [[1 - least, 0.0]], rtol=0, atol=1e-3)


def test_the_closed_form_is_what_newtons_method_finds() -> None:
    """Of balls and rows that other sets keep at a distance, with weights that certify it."""
    batch, dim = 60, 3
    ones = torch.ones(batch, dim, dtype=torch.float64)
    half = 0.3 + 0.5 * torch.rand(batch, dim).double()
    ball = Ball(2 * torch.randn(batch, dim).double(), 0.1 + torch.rand(batch).double())
    rows = HalfSpaces(torch.randn(batch, 2, dim).double(), torch.randn(batch, 2).double() - 1)
    for constraint_set, count in ((ball, 1), (rows, 2)):
        intersection = Intersection.of([Box(-ones, ones), Box(-half, 0.8 * half), constraint_set])
        counts = np.ones((batch, 4 * dim + count), dtype=bool)
        maximized = counts & (np.arange(4 * dim + count) >= 4 * dim)
        required = np.full(counts.shape, 1e-3)
        at = intersection.described
        problem = intersection.program.requiring(
            required[:, at].T, maximized[:, at].T, counts[:, at].T
        )
        start, asked = np.zeros((batch, dim)), []

        def watched(lower: Array, upper: Array, index: Index) -> Flags:
            asked.append(len(index))  # noqa: B023 - called before it changes
            return close(lower, upper, index)

        best = maximize_slack_over_box(problem, start, watched)
        expected = maximize_slack(problem, start, close)
        np.testing.assert_allclose(best.slack, expected.slack, rtol=0, atol=1e-6)
        np.testing.assert_allclose(best.upper_bound, expected.upper_bound, rtol=0, atol=1e-6)
        np.testing.assert_allclose(problem.slack(best.action), best.slack, rtol=0, atol=1e-9)
        # Most need no search.
        assert asked[0] == batch
        assert asked[1:] == [] or max(asked[1:]) < 0.6 * batch
        # Whatever the point, the weighted slacks stay below the bound.
        assert best.weights is not None
        point = (2 * np.random.default_rng(0).random((batch, dim)) - 1) * half.numpy() * 0.8
        rooms = problem.rooms(problem.at(point))
        total = (best.weights * rooms).sum(0) * problem.unit
        assert (total <= best.upper_bound + 1e-6).all()


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_descriptions_agree_with_the_slack(case: Case) -> None:
    batch = case.sets.batch_shape
    index = torch.arange(batch.numel())
    chosen = [part.select(batch, index) for part in (case.bounds, case.sets)]
    problem = program(chosen)
    for direction in case.directions(20, torch.float64):
        action = (case.inside + 2 * direction).expand(*batch, -1).reshape(len(index), -1)
        expected = torch.minimum(*(constraint_set.slack(action) for constraint_set in chosen))
        given = torch.from_numpy(problem.slack(action.numpy()))
        if case.convex:
            torch.testing.assert_close(given, expected, rtol=1e-9, atol=1e-9 * case.size)
        else:
            assert (given <= expected + 1e-9 * case.size).all()
