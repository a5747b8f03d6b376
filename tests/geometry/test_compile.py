"""Gauges, projections and cheap attempts compile without graph breaks, to the same values."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cnfp_torchrl.geometry import (
    Ball,
    Box,
    HalfSpaces,
    attempt_anchor,
    project_onto_intersection,
)
from experiments.random_sets import FAMILIES
from tests.geometry.cases import BOUNDS, CASES, Case
from tests.geometry.test_projection import CASES as INTERSECTIONS
from tests.geometry.test_projection import Case as Intersection
from tests.geometry.test_projection import points

pytestmark = pytest.mark.usefixtures("fresh_compiler")


@pytest.mark.parametrize(
    "case",
    [next(c for c in CASES if c.name.startswith(name)) for name in FAMILIES],
    ids=lambda case: case.name,
)
def test_compiled_gauge_is_the_same(case: Case) -> None:
    direction = case.directions(8, torch.float64)

    def gauge(direction: Tensor, anchor: Tensor, fields: dict[str, Tensor]) -> Tensor:
        return type(case.sets)(**fields, validate_args=False).eroded().gauge(direction, anchor)

    compiled = torch.compile(gauge, fullgraph=True, backend="aot_eager", dynamic=False)
    arguments = (direction, case.inside, case.sets.fields())
    torch.testing.assert_close(compiled(*arguments), gauge(*arguments), rtol=1e-12, atol=0)


@pytest.mark.parametrize(
    "case",
    [INTERSECTIONS[1], INTERSECTIONS[8], INTERSECTIONS[-1]],
    ids=["boxes", "boxes and ball", "Dykstra"],
)
def test_projections_are_one_graph(case: Intersection) -> None:
    region, given = case.region(), points(case, 10)
    compiled = torch.compile(
        lambda point: project_onto_intersection(region, point, 2), backend="eager", fullgraph=True
    )
    torch.testing.assert_close(compiled(given), project_onto_intersection(region, given, 2))


def attempt(low: Tensor, high: Tensor, *fields: Tensor) -> tuple[Tensor, Tensor]:
    """Return what cheap attempts find, by a function of tensors alone."""
    rows, offsets, center, radius = fields
    return attempt_anchor(
        [
            Box(low, high, validate_args=False),
            HalfSpaces(rows, offsets, validate_args=False),
            Ball(center, radius, validate_args=False),
        ]
    )


def test_attempts_are_one_graph() -> None:
    """That they export, too, is in `tests/deploy/test_export.py`."""
    generator = torch.Generator().manual_seed(0)
    normal, radius = (torch.randn(40, 4, 2, generator=generator, dtype=torch.float64) for _ in "ab")
    fields = (
        *BOUNDS.fields().values(),
        normal[:, :2],
        0.3 * radius[:, :2, 0],
        0.5 * normal[:, 2],
        0.4 * radius[:, 3, 0].abs(),
    )
    expected, decided = attempt(*fields)
    assert 0.1 < decided.double().mean() < 0.9
    anchor, flag = torch.compile(attempt, backend="aot_eager", fullgraph=True)(*fields)
    assert (flag == decided).all()
    torch.testing.assert_close(anchor[decided], expected[decided])
