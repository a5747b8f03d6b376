"""The interior-point method's Newton steps against autograd, and what families tell it."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cnfp_torchrl.geometry import Ball, Box, ConstraintSet, Ellipsoid, PositivePart, WeightedL1Ball
from cnfp_torchrl.geometry.barrier import maximize_slack, newton
from cnfp_torchrl.geometry.slack_program import Point, Program
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


def program(chosen: list[ConstraintSet], active: Tensor | None = None) -> Program:
    parts = [part for each in chosen if (part := each.superlevel()) is not None]
    if active is None:
        active = torch.ones(1, len(chosen), dtype=torch.bool)
    return Program.stack(parts, active)


@pytest.mark.parametrize("kinds", [(0,), (0, 3, 4), (0, 1), (0, 1, 2), (0, 1, 2, 3, 4)])
def test_newton_steps_are_those_of_autograd(kinds: tuple[int, ...]) -> None:
    dim = 4
    problem = program([each for i, each in enumerate(sets(dim)) if i in kinds])
    start = problem.start(0.5 * torch.randn(1, dim).double(), torch.ones(1).double())
    eta = torch.tensor([3.0], dtype=torch.float64)
    x = torch.cat([start.action[0], start.slack, start.terms.flatten()])

    def objective(x: Tensor) -> Tensor:
        at = Point(x[None, :dim], x[dim : dim + 1], x[dim + 1 :].view_as(start.terms))
        return (problem.barrier(at) - eta * at.slack)[0]

    gradient = torch.autograd.functional.jacobian(objective, x)
    step = -torch.linalg.solve(torch.autograd.functional.hessian(objective, x), gradient)
    move, decrement = newton(problem, start, eta)
    given = torch.cat([move.action[0], move.slack, move.terms.flatten()])
    torch.testing.assert_close(given, step, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(decrement[0], -gradient @ step, rtol=1e-9, atol=1e-12)


def test_inactive_sets_change_nothing() -> None:
    everything = sets(3)
    active = torch.tensor([[True, False, True, False, True]])
    kept = [each for each, on in zip(everything, active[0], strict=True) if on]
    start, scale = torch.zeros(1, 3).double(), torch.ones(1).double()
    some = maximize_slack(program(everything, active), start, scale, -torch.inf, 0.9)
    only = maximize_slack(program(kept), start, scale, -torch.inf, 0.9)
    for given, expected in zip(some, only, strict=True):
        torch.testing.assert_close(given, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_descriptions_agree_with_the_slack(case: Case) -> None:
    batch = case.sets.batch_shape
    index = torch.arange(batch.numel())
    chosen = [each.select(batch, index) for each in (case.bounds, case.sets)]
    problem = program(chosen, torch.ones(len(index), 2, dtype=torch.bool))
    for way in case.directions(20, torch.float64):
        action = (case.inside + 2 * way).expand(*batch, -1).reshape(len(index), -1)
        expected = torch.minimum(*(each.slack(action) for each in chosen))
        given = problem.slack(action)
        if case.convex:
            torch.testing.assert_close(given, expected, rtol=1e-9, atol=1e-9 * case.size)
        else:
            assert (given <= expected + 1e-9 * case.size).all()
