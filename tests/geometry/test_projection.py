"""Euclidean projections against SciPy's solver, and what every projection must do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch import Tensor

from cnfp_torchrl.geometry import (
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
    project,
    project_onto_intersection,
)
from tests.bijectors.numeric import central_difference, jacobian
from tests.geometry.cases import t


def cube(dim: int, half: float = 1.0) -> Box:
    return Box(torch.full((dim,), -half).double(), torch.full((dim,), half).double())


TIP = Ball(t(1.5, 0.0), t(0.6).squeeze())
"""Reaches 0.1 into the action bounds: the intersection is a thin slice with sharp ends."""


@dataclass(frozen=True)
class Case:
    """An intersection, and how exactly it is projected onto.

    Args:
        name: The id of the test.
        sets: Sets to intersect, the first the box of action bounds.
        rounds: The number of rounds of Dykstra's algorithm.
        error: The largest distance to SciPy's solution, which itself is good to 2e-6.
    """

    name: str
    sets: tuple[ConstraintSet, ...]
    rounds: int = 1
    error: float = 2e-6

    @property
    def dim(self) -> int:
        return self.sets[0].dim

    def region(self, dtype: torch.dtype = torch.float64) -> Region:
        sets = tuple(
            constraint_set.with_fields(lambda field, _: field.to(dtype))
            for constraint_set in self.sets
        )
        return Region(sets, torch.zeros(self.dim, dtype=dtype), validate_args=False)


def random_ball(dim: int, seed: int) -> Ball:
    generator = torch.Generator().manual_seed(seed)
    direction = torch.randn(dim, generator=generator, dtype=torch.float64)
    return Ball(1.2 * direction / direction.norm(), t(0.9).squeeze())


CASES = (
    Case("bounds alone", (cube(3),)),
    Case("two boxes", (cube(2), Box(t(-0.4, -2.0), t(0.3, 0.1)))),
    Case("box and ball inside it", (cube(2), Ball(t(0.1, 0.2), t(0.3).squeeze()))),
    Case("box and ball around it", (cube(2), Ball(t(0.1, 0.2), t(9.0).squeeze()))),
    Case("box and ball across an edge", (cube(2), Ball(t(1.1, 0.2), t(0.9).squeeze()))),
    Case("box and ball at a corner", (cube(2), Ball(t(1.5, 1.5), t(1.0).squeeze()))),
    Case("box and ball in a thin slice", (cube(2), TIP)),
    Case("box and a huge ball", (cube(2), Ball(t(70.0, 20.0), t(73.0).squeeze()))),
    Case(
        "two boxes and a ball",
        (cube(2), Box(t(-1, 0.2), t(0.6, 1.0)), Ball(t(0.9, 0.1), t(0.5)[0])),
    ),
    Case("box and ball, d = 1", (cube(1), Ball(t(0.9), t(0.4)[0]))),
    Case("box and ball, d = 6", (cube(6), random_ball(6, 0))),
    Case("box and ball, d = 20", (cube(20), random_ball(20, 1))),
    Case(
        "two balls",
        (cube(2), Ball(t(0.7, 0.2), t(0.8)[0]), Ball(t(-0.5, 0.0), t(0.8)[0])),
        rounds=200,
    ),
    Case("half-space", (cube(2), HalfSpaces(t(1.0, 1.0)[None], t(0.3))), rounds=100),
    Case(
        "three half-spaces",
        (
            cube(3),
            HalfSpaces(
                torch.tensor([[1.0, 0.2, 0.0], [0.0, 1.0, -1.0], [-1.0, 0.0, 0.5]]).double(),
                t(0.4, 0.1, torch.inf),
            ),
        ),
        rounds=200,
    ),
    Case(
        "half-space and ball",
        (cube(2), HalfSpaces(t(0.0, -2.0)[None], t(0.0)), random_ball(2, 3)),
        rounds=300,
        error=1e-4,
    ),
    Case("weighted L1 ball", (cube(3), WeightedL1Ball(t(3.0, -0.5, 0.0), t(1.1)[0]))),
    Case(
        "weighted L1 ball in a box beside 0",
        (
            cube(3),
            Box(t(0.1, -0.9, -2.0), t(0.7, -0.2, 0.4)),
            WeightedL1Ball(t(1.0, 1.5, 2.0), t(1.3)[0]),
        ),
    ),
    Case("positive part", (cube(3), PositivePart(t(2.0, -1.0, 0.7), t(0.6)[0]))),
    Case(
        "ellipsoid",
        (cube(2), Ellipsoid(t(0.2, -0.1), t(0.6, 0, -0.3, 0.2).reshape(2, 2))),
        rounds=200,
    ),
    Case(
        "task-space ball, unbounded",
        (
            cube(3),
            TaskSpaceBall(t(1.0, 0.3, 0, -0.5, 0.8, 0).reshape(2, 3), t(0.1, 0.2), t(0.4)[0]),
        ),
        rounds=200,
    ),
    Case(
        "limits of power and effort",
        (
            cube(3),
            WeightedL1Ball(t(8.0, -5.0, 1.0), t(6.0)[0]),
            TaskSpaceBall(torch.diag(t(0.9, -0.2, 0.5)), t(0, 0, 0), t(0.3)[0]),
        ),
        rounds=400,
    ),
)
ALL_CASES = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
EXACT_CASES = pytest.mark.parametrize(
    "case", [case for case in CASES if case.rounds == 1], ids=lambda case: case.name
)


def points(case: Case, count: int) -> Tensor:
    generator = torch.Generator().manual_seed(2)
    return 1.5 * torch.randn(count, case.dim, generator=generator, dtype=torch.float64)


def by_scipy(case: Case, point: Tensor) -> Tensor:
    """Solve the same problem from its inequalities, which share no code with the sets."""

    def inequality(constraint_set: ConstraintSet) -> Callable[[np.ndarray], np.ndarray]:
        fields = {name: value.numpy() for name, value in constraint_set.fields().items()}
        match constraint_set:
            case Box():
                return lambda a: np.concatenate([fields["high"] - a, a - fields["low"]])
            case Ball():
                return lambda a: fields["radius"] ** 2 - np.sum((a - fields["center"]) ** 2)
            case HalfSpaces():
                finite = np.isfinite(fields["offsets"])
                return lambda a: (fields["offsets"] - fields["normals"] @ a)[finite]
            case WeightedL1Ball() | PositivePart():
                # All half-spaces, one for each choice of a side of every term.
                sides = (-1, 1) if isinstance(constraint_set, WeightedL1Ball) else (0, 1)
                rows = np.array(list(product(sides, repeat=constraint_set.dim))) * fields["weights"]
                return lambda a: fields["bound"] - rows @ a
            case Ellipsoid():
                inverse = np.linalg.inv(fields["scale_tril"])
                return lambda a: 1 - np.sum((inverse @ (a - fields["center"])) ** 2)
            case TaskSpaceBall():
                jacobian, offset = fields["jacobian"], fields["offset"]
                return lambda a: fields["radius"] ** 2 - np.sum((jacobian @ a + offset) ** 2)
        raise NotImplementedError(type(constraint_set).__name__)

    found = minimize(
        lambda a: 0.5 * np.sum((a - point.numpy()) ** 2),
        x0=np.zeros(case.dim),
        jac=lambda a: a - point.numpy(),
        constraints=[
            {"type": "ineq", "fun": inequality(constraint_set)} for constraint_set in case.sets
        ],
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 500},
    )
    return torch.from_numpy(found.x)


@ALL_CASES
def test_the_closest_point_is_the_solver_s(case: Case) -> None:
    given = points(case, 12)
    closest = project_onto_intersection(case.region(), given, case.rounds)
    expected = torch.stack([by_scipy(case, point) for point in given])
    assert case.region().slack(expected).min() > -1e-7, "the solver failed"
    assert ((closest - given).norm(dim=-1) > 1e-3).any(), "nothing is projected: shows nothing"
    assert (closest - expected).norm(dim=-1).max() <= case.error


@EXACT_CASES
def test_exact_projections_are_optimal(case: Case) -> None:
    """The variational inequality: no allowed action lies in the direction of the given point."""
    region, given = case.region(), points(case, 200)
    closest = project_onto_intersection(region, given, case.rounds)
    others = project_onto_intersection(region, points(case, 3000)[-500:], 1)
    assert region.slack(closest).min() >= -1e-13 * 73
    gain = ((others.unsqueeze(1) - closest) * (given - closest)).sum(-1)
    assert gain.max() <= 1e-11


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@ALL_CASES
def test_both_dtypes_and_any_batch_shape(case: Case, dtype: torch.dtype) -> None:
    given = points(case, 60)
    expected = project_onto_intersection(case.region(), given, case.rounds)
    closest = project_onto_intersection(
        case.region(dtype), given.to(dtype).reshape(3, 20, case.dim), case.rounds
    )
    assert closest.dtype == dtype
    precision = 1e-3 if "huge" in case.name else 2e-5  # 73^2 rounding errors, over a width of 1
    tolerance = precision if dtype == torch.float32 else 1e-12
    torch.testing.assert_close(closest.reshape(60, -1), expected.to(dtype), rtol=0, atol=tolerance)


@ALL_CASES
def test_gradients_are_the_projection_s(case: Case) -> None:
    # Random points lie on no kink; a step of 1e-6 stays on the same piece. All components of all
    # points at once, which `gradcheck` would take one by one through all rounds; and of any number
    # of rounds the gradient is that of what they compute.
    given, region = points(case, 3), case.region()

    def onto(point: Tensor) -> Tensor:
        return project_onto_intersection(region, point, min(case.rounds, 50))

    axes = torch.eye(case.dim, dtype=torch.float64).unsqueeze(1)
    columns = central_difference(onto, given, axes, 1e-6).movedim(0, -1)
    torch.testing.assert_close(jacobian(onto, given), columns, rtol=1e-3, atol=1e-5)


@ALL_CASES
def test_gradients_are_finite_where_points_are_special(case: Case) -> None:
    special = [torch.zeros(case.dim), torch.ones(case.dim), torch.full((case.dim,), 1e6)]
    special += [
        constraint_set.center for constraint_set in case.sets if isinstance(constraint_set, Ball)
    ]
    given = torch.stack([point.double() for point in special]).requires_grad_()
    project_onto_intersection(case.region(), given, case.rounds).sum().backward()
    assert given.grad is not None
    assert given.grad.isfinite().all()


def test_dropped_sets_are_left_out() -> None:
    ball, box = Ball(t(5.0, 5.0), t(1.0)[0]), Box(t(-9, -9), t(-5, -5.0))
    sets, given = (cube(2), ball, box), torch.randn(50, 2, dtype=torch.float64)
    active = torch.tensor([True, False, False])
    region = Region(sets, t(0, 0), active)
    closest = project_onto_intersection(region, given, 1)
    torch.testing.assert_close(closest, given.clamp(-1, 1), rtol=0, atol=0)


@pytest.mark.parametrize("rows", [1, 2])
def test_dropped_half_spaces_are_left_out(rows: int) -> None:
    away = HalfSpaces(t(1.0, 0.0).expand(rows, 2), t(-5.0).expand(rows))
    given = torch.randn(50, 2, dtype=torch.float64)
    region = Region((cube(2), away), t(0, 0), torch.tensor([True, False]))
    closest = project_onto_intersection(region, given, 3)
    torch.testing.assert_close(closest, given.clamp(-1, 1), rtol=0, atol=0)


def test_each_batch_element_has_its_own_flags() -> None:
    ball = Ball(torch.zeros(2, 2).double(), t(0.5, 0.5))
    active = torch.tensor([[True, True], [True, False]])
    given = t(3.0, 0.0).expand(2, 2)
    closest = project_onto_intersection(Region((cube(2), ball), t(0, 0), active), given, 1)
    torch.testing.assert_close(closest, torch.tensor([[0.5, 0.0], [1.0, 0.0]]).double())


def test_more_rounds_come_closer() -> None:
    balls = (Ball(t(0.7, 0.2), t(0.8)[0]), Ball(t(-0.5, 0.0), t(0.8)[0]))
    region = Region((cube(2), *balls), t(0.1, 0.1))
    given = torch.randn(200, 2, dtype=torch.float64)
    best = project_onto_intersection(region, given, 2000)
    errors = [
        float((project_onto_intersection(region, given, rounds) - best).norm(dim=-1).max())
        for rounds in (1, 5, 25, 125)
    ]
    assert errors == sorted(errors, reverse=True)
    assert errors[0] > 1e-2
    assert errors[-1] < 1e-6


def visible(count: int, rectangles: int) -> VisibleRegion:
    """Return what random rectangles around 0 leave to be seen from there."""
    center = 0.9 * torch.nn.functional.normalize(torch.randn(count, rectangles, 2).double(), dim=-1)
    half = 0.1 + 0.3 * torch.rand(count, rectangles, 2).double()
    corners = torch.stack([center - half, center + half], -2)
    return VisibleRegion(torch.zeros(count, 2).double(), corners, torch.ones(count).double())


@pytest.mark.parametrize("rectangles", [1, 2])
def test_the_closest_visible_point_is_that_of_a_grid(rectangles: int) -> None:
    torch.manual_seed(rectangles)
    seen = visible(20, rectangles)
    ball = Ball(torch.zeros(20, 2).double(), torch.full((20,), 1.2).double())
    region = Region((cube(2), ball, seen), torch.zeros(20, 2).double())
    given = 1.5 * torch.randn(4, 20, 2).double()
    axis = torch.linspace(-1, 1, 161).double()
    grid = torch.cartesian_prod(axis, axis).unsqueeze(1)
    inside = region.contains(grid)
    best = torch.stack(
        [(grid - row).norm(dim=-1).masked_fill(~inside, torch.inf).amin(0) for row in given]
    )
    closest = project_onto_intersection(region, given, 300)
    assert region.contains(closest).all()
    distance = (closest - given).norm(dim=-1)
    # Every point of the grid is further away, and the closest one by less than its diagonal.
    assert (distance <= best + 1e-4).all()
    assert (distance >= best - 0.018).all()


def test_a_rectangle_is_passed_on_the_nearer_side() -> None:
    corners = t(0.5, -0.2, 0.7, 0.6).reshape(1, 2, 2)
    seen = VisibleRegion(t(0, 0), corners, t(1.0)[0])
    region = Region((cube(2), seen), t(-0.5, 0))
    given = torch.stack([t(0.55, -0.1), t(0.9, -0.3), t(0.6, 0.6), t(-0.2, 0.9)])
    # Before it, beside it on either side of its shadow, and where it is not in the way.
    below, above = (
        torch.nn.functional.normalize(t(*corner), dim=-1) for corner in [(0.5, -0.2), (0.5, 0.6)]
    )
    expected = torch.stack(
        [t(0.5, -0.1), (given[1] @ below) * below, (given[2] @ above) * above, given[3]]
    )
    closest = project_onto_intersection(region, given, 1)
    torch.testing.assert_close(closest, expected, rtol=0, atol=1e-9)


def test_dropped_non_convex_sets_are_left_out() -> None:
    seen = visible(5, 1)
    given = torch.randn(50, 5, 2, dtype=torch.float64)
    active = torch.tensor([True, False])
    region = Region((cube(2), seen), torch.zeros(5, 2).double(), active)
    closest = project_onto_intersection(region, given, 1)
    torch.testing.assert_close(closest, given.clamp(-1, 1), rtol=0, atol=1e-12)


def test_non_convex_families_alone_have_no_closed_form() -> None:
    walls = VisibleRegion.walls(t(-1, -1), t(1, 1))
    region = VisibleRegion(t(0, 0), walls, t(1.0)[0])
    with pytest.raises(TypeError, match=r"or .* given VisibleRegion; .*project_onto_intersection"):
        project(region, t(2, 2))
    closest = project_onto_intersection(Region((cube(2, 3.0), region), t(0, 0)), t(2, 2), 1)
    torch.testing.assert_close(closest, t(1, 1), rtol=0, atol=1e-12)


def test_several_rows_have_no_closed_form_of_their_own() -> None:
    with pytest.raises(TypeError, match="expected HalfSpaces of one row, given 2"):
        project(HalfSpaces(torch.eye(2).double(), t(1, 1)), t(2, 2))
