"""The contract of a set, kept by every family over the table of `cases`."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cnfp_torchrl.geometry import ConstraintSet, PositivePart, WeightedL1Ball
from cnfp_torchrl.testing import check_constraint_set
from tests.geometry.cases import CASES, DTYPES, Case


@pytest.mark.parametrize("number", range(len(CASES)), ids=[case.name for case in CASES])
def test_shipped_families_keep_the_contract(number: int) -> None:
    case, dtype = CASES[number], DTYPES[number % 2]
    # With bounds that are given, and with those that the checker chooses.
    bounds = case.bounds.to(dtype) if number % 3 else None
    check_constraint_set(case.sets.to(dtype), case.inside.to(dtype), bounds=bounds, samples=40)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_gradients_in_the_fields_are_those_of_finite_differences(case: Case) -> None:
    """As learned or differentiable geometry needs them; the checker asks for none in fields."""
    direction = torch.randn_like(case.inside) * case.size
    fields = case.sets.fields()
    # Differentiate by the logarithm of a factor of each, as sizes differ by 1e6. The zeros above a
    # triangular matrix's diagonal stay zero.
    logs = [torch.zeros_like(value).requires_grad_() for value in fields.values()]

    def gauge(*logs: Tensor) -> Tensor:
        moved = {
            name: torch.where(value.isfinite(), value.nan_to_num() * log.exp(), value)
            for (name, value), log in zip(fields.items(), logs, strict=True)
        }
        return type(case.sets)(**moved, validate_args=False).gauge(direction, case.inside)

    assert torch.autograd.gradcheck(gauge, logs, fast_mode=True, eps=1e-7, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_what_was_asked_before_changes_no_shape(case: Case) -> None:
    def shapes(sets: ConstraintSet) -> list[torch.Size]:
        values = [*sets.bounding_box(), sets.rounding(), sets.eroded().slack(case.inside)]
        return [
            value.shape
            for value in (*values, *sets.select(sets.batch_shape, every).fields().values())
        ]

    every = torch.arange(case.sets.batch_shape.numel())
    asked, other = (case.sets.with_fields(lambda field, _: field) for _ in range(2))
    more = case.inside.expand(3, *case.inside.shape)
    asked.slack(more)
    asked.gauge(torch.ones_like(more), more)
    assert shapes(asked) == shapes(other)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_gradients_follow_what_was_asked_in_inference_mode(case: Case) -> None:
    sets = case.sets.with_fields(lambda field, _: field)
    with torch.inference_mode():
        sets.slack(case.inside)
    action = case.inside.clone().requires_grad_()
    sets.slack(action).sum().backward()
    assert action.grad is not None


@pytest.mark.parametrize("family", [WeightedL1Ball, PositivePart])
def test_gauges_end_at_the_boundary_where_terms_vanish_together(
    family: type[WeightedL1Ball | PositivePart],
) -> None:
    """On the way from a corner to a point with zeros all kinks are one, up to rounding."""
    random = torch.Generator().manual_seed(0)
    weights = torch.randn(2000, 32, generator=random)
    sizes = 10 ** (-9 + 3 * torch.rand(2000, 1, generator=random))
    anchor = sizes * torch.randn(2000, 32, generator=random)
    anchor[:, 3] = 0.999 / weights[:, 3]
    point = torch.zeros(2000, 32)
    point[:, 5] = 2 / weights[:, 5]
    sets = family(weights, torch.ones(2000))
    gauge = sets.gauge(point - anchor, anchor)

    def end(share: float) -> Tensor:
        step = share / gauge.double().unsqueeze(-1)
        return anchor.double() + step * (point.double() - anchor.double())

    assert sets.contains(end(0.9)).all()
    assert not sets.contains(end(1.1)).any()
