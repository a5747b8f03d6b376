"""Bad sets are refused with a message that names constraint, field, index, expected and given."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

from cnfp_torchrl.geometry import (
    Ball,
    Box,
    ConstraintSet,
    Ellipsoid,
    GeometryError,
    HalfSpaces,
    PositivePart,
    Region,
    TaskSpaceBall,
    VisibleRegion,
    WeightedL1Ball,
)

NAN, INF = float("nan"), float("inf")


def t(*values: Any) -> Tensor:
    return torch.tensor(values)


RECTANGLES = t([[1.0, 1.0], [2.0, 2.0]])

BAD: list[tuple[Callable[[], ConstraintSet], tuple[str, ...]]] = [
    (lambda: Box(t(0.0, 2.0), t(1.0, 1.0)), ("Box", "'low'", "[1]", "low <= high", "2.0")),
    (lambda: Box(t([0.0], [NAN]), t(1.0)), ("Box", "'low'", "[1, 0]", "a number", "nan")),
    (lambda: Ball(t(0.0, INF), t(1.0)[0]), ("Ball", "'center'", "[1]", "finite", "inf")),
    (lambda: Ball(t(0.0, 0.0), t(1.0, -0.5, 1.0)), ("Ball", "'radius'", "[1]", ">= 0", "-0.5")),
    (lambda: Ball(t(0.0, 0.0), t(-2.0)), ("Ball", "'radius'", "[0]", ">= 0", "-2.0")),
    (lambda: Ball(t(0.0), t(INF)), ("Ball", "'radius'", "[0]", "finite", "inf")),
    (
        lambda: Ellipsoid(t(0.0, 0.0), t([1.0, 0.0], [0.5, -1.0])),
        ("Ellipsoid", "'scale_tril'", "[1, 1]", "positive diagonal", "-1.0"),
    ),
    (
        lambda: Ellipsoid(t(0.0, 0.0), t([1.0, 0.25], [0.0, 1.0])),
        ("Ellipsoid", "'scale_tril'", "[0, 1]", "zeros above the diagonal", "0.25"),
    ),
    (
        lambda: Ellipsoid(t(0.0, 0.0), t([1.0, 0.0], [INF, 1.0])),
        ("Ellipsoid", "'scale_tril'", "[1, 0]", "finite", "inf"),
    ),
    (
        lambda: Ellipsoid(t(0.0, 0.0), t([1.0, 0.0])),
        ("Ellipsoid", "square 'scale_tril'", "1 by 2"),
    ),
    (
        lambda: HalfSpaces(t([1.0, INF]), t(1.0)),
        ("HalfSpaces", "'normals'", "[0, 1]", "finite", "inf"),
    ),
    (
        lambda: HalfSpaces(t([1.0, 0.0]), t(-INF)),
        ("HalfSpaces", "'offsets'", "[0]", "above -inf", "-inf"),
    ),
    (
        lambda: HalfSpaces(t([1.0, 0.0]), t(1.0, 2.0)),
        ("HalfSpaces", "as many offsets as normals", "2 and 1"),
    ),
    (
        lambda: TaskSpaceBall(t([1.0, 0.0]), t(0.0), t(-0.5)[0]),
        ("TaskSpaceBall", "'radius'", ">= 0", "-0.5"),
    ),
    (
        lambda: TaskSpaceBall(t([1.0, -INF]), t(0.0), t(1.0)[0]),
        ("TaskSpaceBall", "'jacobian'", "[0, 1]", "finite", "-inf"),
    ),
    (
        lambda: TaskSpaceBall(t([1.0, 0.0]), t(0.0, 1.0), t(1.0)[0]),
        ("TaskSpaceBall", "as many components of the offset as rows of the jacobian", "2 and 1"),
    ),
    (
        lambda: WeightedL1Ball(t(1.0, INF), t(1.0)[0]),
        ("WeightedL1Ball", "'weights'", "[1]", "finite", "inf"),
    ),
    (
        lambda: WeightedL1Ball(t(1.0, 1.0), t(1.0, -0.5)),
        ("WeightedL1Ball", "'bound'", "[1]", ">= 0", "-0.5"),
    ),
    (
        lambda: PositivePart(t(1.0, 1.0), t(-1.0)),
        ("PositivePart", "'bound'", "[0]", ">= 0", "-1.0"),
    ),
    (
        lambda: VisibleRegion(t(0.0, 0.0), RECTANGLES.flip(-2), t(1.0)[0]),
        ("VisibleRegion", "'rectangles'", "[0, 0, 0]", "low <= high", "2.0"),
    ),
    (
        lambda: VisibleRegion(t(0.0, 0.0), t([[-INF, -INF], [INF, INF]]), t(1.0)[0]),
        ("VisibleRegion", "'rectangles'", "[0, 0, 0]", "a finite bound", "-inf"),
    ),
    (
        lambda: VisibleRegion(t(0.0, INF), RECTANGLES, t(1.0)[0]),
        ("VisibleRegion", "'position'", "[1]", "finite", "inf"),
    ),
    (
        lambda: VisibleRegion(t(0.0, 0.0), RECTANGLES, t(1.0, 0.0)),
        ("VisibleRegion", "'step'", "[1]", "> 0", "0.0"),
    ),
    (
        lambda: VisibleRegion(t(0.0, 0.0), RECTANGLES[:, :1], t(1.0)),
        ("VisibleRegion", "m >= 1, 2, d", "(1, 1, 2)"),
    ),
    (lambda: Ball(t(0.0, 0.0).half(), t(1.0).half()), ("Ball", "'center'", "float32", "float16")),
    (lambda: Box(t(0.0).bfloat16(), t(1.0).bfloat16()), ("Box", "'low'", "bfloat16", "convert")),
    (lambda: Ball(t(0.0, 0.0), t(1.0).double()), ("Ball", "one dtype", "float32", "float64")),
    (lambda: Ball(t(0, 0), t(1.0)), ("Ball", "'center'", "float32 or float64", "int64")),
    (lambda: Ball(t(0.0, 0.0), 1.0), ("Ball", "'radius'", "tensor", "float")),  # type: ignore[arg-type]
    (lambda: Ball(torch.tensor(0.0), t(1.0)), ("Ball", "'center'", "1 dimensions", "()")),
    (lambda: Box(t(0.0, 0.0), t(1.0, 1.0, 1.0)), ("Box", "one action dimension", "2", "3")),
    (lambda: Box(torch.zeros(0), torch.ones(0)), ("Box", "d >= 1")),
    (
        lambda: Ball(torch.zeros(3, 2), torch.ones(4)),
        ("Ball", "batch shapes that broadcast", "(3, 2)", "(4,)"),
    ),
]


@pytest.mark.parametrize(
    ("make", "words"), BAD, ids=lambda x: "-".join(x) if type(x) is tuple else ""
)
def test_bad_fields_are_refused(make: Callable[[], ConstraintSet], words: tuple[str, ...]) -> None:
    with pytest.raises(GeometryError) as caught:
        make()
    for word in words:
        assert word in str(caught.value)


def test_the_constraint_is_named() -> None:
    ball = Ball(t(0.0, 0.0), t(1.0, -1.0), validate_args=False)
    with pytest.raises(
        GeometryError, match=r"constraint 'battery' \(Ball\), field 'radius' at index"
    ):
        ball.validate("battery")


def test_a_valid_set_is_returned() -> None:
    box = Box(t(0.0, -INF), t(INF, 1.0))
    assert box.validate("obstacle") is box


def test_a_region_needs_action_bounds_first() -> None:
    ball = Ball(t(0.0, 0.0), torch.tensor(1.0))
    with pytest.raises(GeometryError, match=r"sets\[0\]: expected the Box of action bounds"):
        Region((ball,), t(0.0, 0.0))
    with pytest.raises(GeometryError, match="one action dimension"):
        Region((Box(t(-1.0), t(1.0)), ball), t(0.0, 0.0))


def test_a_region_without_an_anchor_has_sets_but_no_gauges() -> None:
    bounds, ball = Box(t(-1.0, -1.0), t(1.0, 1.0)), Ball(t(0.0, 0.0), t(2.0, 0.5))
    region = Region((bounds, ball)).to(torch.float64)
    assert region.shape == (2, 2)
    assert region.contains(t(0.6, 0.6)).tolist() == [True, False]
    assert region.is_active.shape == region.amounts().shape == (2, 2)
    for needs_one in (region.eroded, lambda: region.gauges(t(1.0, 0.0)), lambda: region.anchor):
        with pytest.raises(GeometryError, match=r"anchor: expected a point .*Region\.build"):
            needs_one()


def test_sets_without_interior_are_sets() -> None:
    zero = t(0.0)[0]
    for constraint_set in (
        Box(t(0.5, -1.0), t(0.5, 1.0)),
        Ball(t(0.0, 0.0), zero),
        TaskSpaceBall(t([1.0, 0.0]), t(0.0), zero),
        WeightedL1Ball(t(1.0, 1.0), zero),
        PositivePart(t(1.0, 0.0), zero),
    ):
        assert constraint_set.slack(t(0.5, 0.5)).isfinite()
        wider = constraint_set.inflated(t(0.25))
        assert wider.contains(t(0.5, 0.0) if isinstance(constraint_set, Box) else t(0.0, 0.0))


@pytest.mark.parametrize("event_dims", [None, {"radius": 0}, {"center": 0, "radius": 0}])
def test_a_family_must_state_its_event_dims(event_dims: dict[str, int] | None) -> None:
    @dataclass(frozen=True, eq=False)
    class Disc(ConstraintSet):
        center: Tensor
        radius: Tensor

        slack = gauge = eroded = around = None

    if event_dims is not None:
        Disc.event_dims = event_dims
    with pytest.raises(GeometryError, match=r"Disc: expected event_dims with .*'center', 'radius'"):
        Disc(t(0.0, 0.0), torch.tensor(1.0))


def test_of_ends_that_are_the_wrong_way_round_both_are_told() -> None:
    with pytest.raises(GeometryError, match=r"'low' at index \[1\]: .*given 2\.0, high -1\.0$"):
        Box(torch.tensor([0.0, 2.0]), torch.tensor([1.0, -1.0]))


def test_of_numbers_that_are_no_tensor_the_type_is_told() -> None:
    numbers: Any = torch.zeros(2).numpy()
    with pytest.raises(GeometryError, match=r"float32 or float64 tensor, given ndarray; convert"):
        Box(numbers, torch.ones(2))
