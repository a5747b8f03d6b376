"""The interior-point method's Newton steps against autograd, and what families tell it."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cnfp_torchrl.geometry import Ball, Box, ConstraintSet, Ellipsoid, PositivePart, WeightedL1Ball
from cnfp_torchrl.geometry.anchor.interior_point import newton
from cnfp_torchrl.geometry.anchor.intersection import Intersection
from cnfp_torchrl.geometry.anchor.program import Point, Program
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


def program(chosen: list[ConstraintSet], batch: int = 1) -> Program:
    return Program.stack([part for each in chosen if (part := each.superlevel())], batch)


def close(lower: Tensor, upper: Tensor, index: Tensor) -> Tensor:
    """Tell where bounds are close."""
    return upper - lower <= 1e-7


@pytest.mark.parametrize("kinds", [(0,), (0, 3, 4), (0, 1), (0, 1, 2), (0, 1, 2, 3, 4)])
def test_newton_steps_are_those_of_autograd(kinds: tuple[int, ...]) -> None:
    dim = 4
    problem = program([each for i, each in enumerate(sets(dim)) if i in kinds])
    start = problem.start(0.5 * torch.randn(1, dim).double(), torch.ones(1).double())
    eta = torch.tensor([3.0], dtype=torch.float64)
    x = torch.cat([start.action[0], start.slack, start.terms.flatten()])

    def objective(x: Tensor) -> Tensor:
        at = Point(x[None, :dim], x[dim : dim + 1], x[dim + 1 :].view_as(start.terms))
        return (problem.barrier(problem.distances(at)) - eta * at.slack)[0]

    gradient = torch.autograd.functional.jacobian(objective, x)
    step = -torch.linalg.solve(torch.autograd.functional.hessian(objective, x), gradient)
    move, decrement = newton(problem, start, problem.distances(start), eta)
    given = torch.cat([move.action[0], move.slack, move.terms.flatten()])
    torch.testing.assert_close(given, step, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(decrement[0], -gradient @ step, rtol=1e-9, atol=1e-12)


def test_rows_that_do_not_count_change_nothing() -> None:
    everything, chosen = sets(3), [True, False, True, False, True]
    kept = [each for each, on in zip(everything, chosen, strict=True) if on]
    results = []
    for some, counts in ((everything, chosen), (kept, [True] * 3)):
        intersection = Intersection.of(some)
        width = intersection.widths[0]
        on = torch.tensor([[counts[0]] * width + counts[1:]])
        required = torch.zeros(on.shape, dtype=torch.float64)
        start = torch.zeros(1, 3).double()
        results.append(intersection.maximize(required, on, on, start, close))
    for given, expected in zip(*results, strict=True):
        torch.testing.assert_close(given, expected, rtol=1e-6, atol=1e-6)


def test_what_is_required_is_kept() -> None:
    """The ball's slack is the largest where the bounds' slack is what is required of them."""
    ones = torch.ones(1, 2, dtype=torch.float64)
    chosen = [Box(-ones, ones), Ball(3 * ones * torch.tensor([1.0, 0.0]), ones[:, 0])]
    intersection = Intersection.of(chosen)
    counts = torch.ones(1, 5, dtype=torch.bool)
    trial = torch.tensor([[False] * 4 + [True]])
    for least in (0.0, 0.1):
        required = torch.tensor([[least] * 4 + [0.0]]).double()
        best = intersection.maximize(required, trial, counts, 0 * ones, close)
        assert best.slack.item() == pytest.approx(-1 - least, abs=1e-6)
        torch.testing.assert_close(
            best.action, torch.tensor([[1 - least, 0.0]]).double(), rtol=0, atol=1e-3
        )


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_descriptions_agree_with_the_slack(case: Case) -> None:
    batch = case.sets.batch_shape
    index = torch.arange(batch.numel())
    chosen = [each.select(batch, index) for each in (case.bounds, case.sets)]
    problem = program(chosen, len(index))
    for direction in case.directions(20, torch.float64):
        action = (case.inside + 2 * direction).expand(*batch, -1).reshape(len(index), -1)
        expected = torch.minimum(*(each.slack(action) for each in chosen))
        given = problem.slack(action)
        if case.convex:
            torch.testing.assert_close(given, expected, rtol=1e-9, atol=1e-9 * case.size)
        else:
            assert (given <= expected + 1e-9 * case.size).all()
