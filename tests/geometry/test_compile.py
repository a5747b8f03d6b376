"""Gauges compile without graph breaks, and give the same values."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from experiments.random_sets import FAMILIES
from tests.geometry.cases import CASES, Case


@pytest.mark.parametrize(
    "case",
    [next(c for c in CASES if c.name.startswith(name)) for name in FAMILIES],
    ids=lambda case: case.name,
)
def test_compiled_gauge_is_the_same(case: Case) -> None:
    direction = case.directions(8, torch.float64)

    def gauge(direction: Tensor, anchor: Tensor, fields: dict[str, Tensor]) -> Tensor:
        return type(case.sets)(**fields, validate_args=False).eroded().gauge(direction, anchor)

    torch.compiler.reset()
    compiled = torch.compile(gauge, fullgraph=True, backend="aot_eager", dynamic=False)
    arguments = (direction, case.inside, case.sets.fields())
    torch.testing.assert_close(compiled(*arguments), gauge(*arguments), rtol=1e-12, atol=0)
