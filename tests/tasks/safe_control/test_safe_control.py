"""Safe control: rows by hand against the judge by automatic differentiation; published starts."""

from functools import partial

import torch

from cnfp_torchrl.tasks.safe_control import (
    Problem,
    barrier_excess,
    barrier_rows,
    episode,
    nominal_control,
    starts,
)
from cnfp_torchrl.tasks.safe_control.judge import barrier_values, ellipse_values

PROBLEM = Problem()


def test_rows_are_the_judge_s() -> None:
    torch.manual_seed(0)
    state, control = 2 * torch.randn(500, 5).double(), 20 * torch.randn(500, 2).double()
    rows = barrier_rows(PROBLEM, state)
    by_rows = (rows.normals @ control.unsqueeze(-1)).squeeze(-1) - rows.offsets
    judged = barrier_excess(PROBLEM, state, control)
    torch.testing.assert_close(by_rows, judged, rtol=1e-7, atol=1e-5)
    # The rows are the stricter ones, by more than rounding.
    assert (by_rows > judged).all()


def test_starts_are_safe_and_the_same_each_time() -> None:
    states = starts(partial(barrier_values, PROBLEM))
    assert states.shape == (1000, 5)
    assert (barrier_values(PROBLEM, states) >= 0).all()
    torch.testing.assert_close(states, starts(partial(barrier_values, PROBLEM)))


def test_the_nominal_controller_runs_into_the_obstacles_and_is_told() -> None:
    states = starts(partial(barrier_values, PROBLEM))[:20]
    run = episode(PROBLEM, states, nominal_control, judge=partial(barrier_excess, PROBLEM))
    assert run.violations > 0
    assert run.largest > 0
    assert (ellipse_values(PROBLEM, states) > 0).all()
