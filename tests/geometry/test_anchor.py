"""Which sets hold together, and anchors: cases done by hand and exact interval arithmetic."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch
from torch import Tensor

from cnfp_torchrl.bijectors import ExactSquash
from cnfp_torchrl.geometry import (
    DEPTH,
    LEEWAY,
    Anchored,
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
    attempt_anchor,
    chebyshev_center,
    lexicographic_anchor,
)
from tests.geometry.cases import BOUNDS, DTYPES, LEAST, t


def box(low: tuple[float, float], high: tuple[float, float]) -> Box:
    return Box(t(*low), t(*high))


def beyond(angle: float, offset: float) -> HalfSpaces:
    """Actions at least so far in a direction, given in degrees."""
    radians = torch.deg2rad(t(angle))
    return HalfSpaces(-torch.cat([radians.cos(), radians.sin()])[None], -t(offset))


LEFT, RIGHT = box((-1.0, -1.0), (-0.2, 1.0)), box((0.2, -1.0), (1.0, 1.0))
DISC = Ball(t(0.9, 0.0), t(0.5)[0])
OUTSIDE = Ball(t(9.0, 0.0), t(0.5)[0])
# The three half-planes of a triangle turned inside out: any two meet, all three do not.
TRIANGLE = (beyond(0.0, 0.1), beyond(120.0, 0.1), beyond(240.0, 0.1))


@dataclass(frozen=True)
class Scenario:
    """Constraints in order of application, the last with the highest priority, and who holds."""

    name: str
    constraints: tuple[ConstraintSet, ...]
    holds: tuple[bool, ...]


SCENARIOS = [
    Scenario("unconstrained", (), ()),
    Scenario("all hold", (LEFT, box((-0.9, 0.0), (0.5, 0.5))), (True, True)),
    Scenario("the higher of two", (LEFT, RIGHT), (False, True)),
    Scenario("the higher of two, turned round", (RIGHT, LEFT), (False, True)),
    # From the lowest up, LEFT would win over RIGHT, and the disc would lose the pair's winner.
    Scenario("lowest-first loses two", (LEFT, RIGHT, DISC), (False, True, True)),
    # Each pair meets, so a rule for pairs would keep all three.
    Scenario("pairs meet, three do not", TRIANGLE, (False, True, True)),
    Scenario("pairs meet, three do not, permuted", TRIANGLE[::-1], (False, True, True)),
    # What conflicts gives way no more than it must: to the edge of RIGHT, out of the disc's reach.
    Scenario("one in the middle", (DISC, LEFT, RIGHT), (False, False, True)),
    Scenario("a relaxed one leaves room", (LEFT, TRIANGLE[0], LEFT), (True, False, True)),
    Scenario("four", (*TRIANGLE, DISC), (True, False, False, True)),
    Scenario("outside the bounds", (OUTSIDE,), (False,)),
    Scenario("outside the bounds, above others", (LEFT, OUTSIDE), (False, False)),
    Scenario("nothing holds", (OUTSIDE, box((2.0, 2.0), (3.0, 3.0))), (False, False)),
    Scenario(
        "other families",
        (
            PositivePart(t(-4.0, 0.0), t(0.4)[0]),  # a_0 >= -0.1
            WeightedL1Ball(t(1.0, 1.0), t(0.3)[0]),
            beyond(180.0, 0.2),  # a_0 <= -0.2
            Ellipsoid(t(-0.3, 0.0), t([0.3, 0.0], [0.1, 0.2])),
        ),
        (False, True, True, True),
    ),
]


def check(sets: Sequence[ConstraintSet], found: Anchored) -> None:
    """Check that an anchor is inside the eroded sets, in the arithmetic that flows use."""
    region = Region(tuple(sets), *found)
    width = (region.bounds.high - region.bounds.low).amin(-1)
    assert (region.eroded().slack(found.anchor) > DEPTH * width / 2).all()
    assert found.anchor.isfinite().all()
    largest = found.largest()
    assert (largest[found.active] == 0).all()
    assert (largest[~found.active] > 0).all()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
def test_scenario(scenario: Scenario, dtype: torch.dtype) -> None:
    sets = [s.with_fields(lambda f, _: f.to(dtype)) for s in (BOUNDS, *scenario.constraints)]
    for candidate in (None, torch.full((2,), torch.nan), t(0.0, 0.0), t(5.0, 5.0)):
        candidate = candidate if candidate is None else candidate.to(dtype)
        found = lexicographic_anchor(sets, candidate)
        assert found.active.tolist() == [True, *scenario.holds]
        assert found.anchor.dtype == dtype
        check(sets, found)


def test_one_batch_of_different_states() -> None:
    """Intervals and balls in every relation to each other, in one batch with two dimensions."""
    rows = [
        # ball's center, box's low and high in the first component: who holds of (box, ball)
        (0.0, -0.5, 0.5, (True, True)),
        (0.9, -0.9, -0.5, (False, True)),
        (3.0, -0.5, 0.5, (False, False)),
        (3.0, 2.0, 4.0, (False, False)),
        (0.9, 1.1, 4.0, (False, True)),
        (0.5, 0.99, 4.0, (True, True)),
    ]
    count = len(rows)
    low, high = torch.zeros(count, 2).double() - 1, torch.ones(count, 2).double()
    center = torch.zeros(count, 2).double()
    for i, (at, lowest, highest, _) in enumerate(rows):
        low[i, 0], high[i, 0], center[i, 0] = lowest, highest, at
    expected = torch.tensor([(True, *holds) for *_, holds in rows])
    for shape in ((count,), (2, 3), (count, 1)):
        boxes = Box(low.view(*shape, 2), high.view(*shape, 2))
        balls = Ball(center.view(*shape, 2), t(0.5)[0])
        shaped = [BOUNDS, boxes, balls]
        candidate = torch.zeros(2).double()
        for start in (None, candidate, candidate.expand(*shape, 2)):
            found = lexicographic_anchor(shaped, start)
            assert found.anchor.shape == (*shape, 2)
            assert (found.active.reshape(count, 3) == expected).all()
            check(shaped, found)


@pytest.mark.parametrize("dim", [1, 3])
def test_boxes_against_interval_arithmetic(dim: int) -> None:
    """Every side of every box, as each component is an interval of its own."""
    count, constraints = 300, 4
    middle = 0.6 * torch.randn(constraints, count, dim, dtype=torch.float64)
    half = 0.1 + 0.8 * torch.rand(constraints, count, dim, dtype=torch.float64)
    ones = torch.ones(dim, dtype=torch.float64)
    sets = [Box(-ones, ones), *(Box(m - h, m + h) for m, h in zip(middle, half, strict=True))]
    found = lexicographic_anchor(sets)
    leeway = LEEWAY * 2
    low, high = (LEAST - ones).expand(count, dim), (ones - LEAST).expand(count, dim)
    for k in range(constraints, 0, -1):
        lower, upper = sets[k].low + LEAST, sets[k].high - LEAST  # type: ignore[attr-defined]
        above, below = (low - upper).clamp(min=0), (lower - high).clamp(min=0)
        expected = torch.cat([above, below], -1)
        given = found.relaxation[k]
        short = expected > 0.1 * LEAST
        assert ((given - expected - leeway).abs()[short] < 0.1 * LEAST).all()
        assert (given[expected == 0] == 0).all()
        assert 0.002 < short.double().mean() < 0.5
        above, below = given.chunk(2, -1)
        low, high = low.maximum(lower - below), high.minimum(upper + above)
    slack = Region(tuple(sets), *found).slack(found.anchor)
    assert (slack >= ((high - low).amin(-1) / 2 + LEAST) / 3).all()


def test_the_threshold() -> None:
    for slack, holds in ((1.1 * LEAST, True), (0.9 * LEAST, False)):
        thin = box((0.3 - slack, -1.0), (0.3 + slack, 1.0))
        for other in (thin, HalfSpaces(t([1.0, 0.0], [-1.0, 0.0]), t(0.3 + slack, slack - 0.3))):
            found = lexicographic_anchor([BOUNDS, other])
            assert found.active.tolist() == [True, holds]


@pytest.mark.parametrize("dtype", DTYPES)
def test_thin_and_wide_sets_are_kept(dtype: torch.dtype) -> None:
    for dim in (1, 2, 32):
        ones, point = torch.ones(dim, dtype=dtype), torch.full((dim,), 0.25, dtype=dtype)
        half = torch.tensor(5e-4, dtype=dtype)
        identity = torch.eye(dim, dtype=dtype)
        thin: list[ConstraintSet] = [
            Box(point - half, point + half),
            Ball(point, half),
            Ellipsoid(point, identity * half),
            HalfSpaces(torch.cat([identity, -identity]), torch.cat([point + half, half - point])),
            WeightedL1Ball(ones, half),
            PositivePart(ones, 2 * half),
        ]
        for constraint_set in thin:
            sets = [Box(-ones, ones), constraint_set]
            found = lexicographic_anchor(sets)
            assert found.active.all(), type(constraint_set).__name__
            check(sets, found)
        wide = [Box(-1e3 * ones, 1e3 * ones), Ball(900 * ones, 1e3 * torch.ones((), dtype=dtype))]
        found = lexicographic_anchor(wide)
        assert found.active.all() or dim == 32
        check(wide, found)


def test_a_candidate_decides_where_it_is_roomy() -> None:
    """Without steps inwards, which the middle of the boxes would need here."""
    rows = HalfSpaces(t([1.0, 1.0], [1.0, 0.9]), t(-0.2, 5.0))
    sets = [BOUNDS, box((-0.2, -1.0), (1.0, 1.0)), rows]
    for candidate in (t(0.05, -0.6), t(0.0, -0.55)):
        anchor, decided = attempt_anchor(sets, candidate, steps=0)
        assert decided
        assert min(constraint_set.slack(anchor) for constraint_set in sets) > 0.18
    for candidate in (t(0.9, 0.9), t(torch.nan, 0.0)):
        _, decided = attempt_anchor(sets, candidate, steps=0)
        assert not decided


def test_one_row_beside_boxes_needs_no_steps() -> None:
    """Its deepest point and the bounds of the slack there decide, as those of a ball do."""
    normals, offsets = torch.randn(500, 1, 3), 1.5 * torch.rand(500, 1) - 0.5
    normals[:50, :, 1] = 0
    for side in (1.0, 0.7):
        bounds = Box(-torch.ones(500, 3), torch.tensor([1.0, side, 1.0]).expand(500, 3))
        sets = [bounds, HalfSpaces(normals, offsets * normals.norm(dim=-1))]
        anchor, decided = attempt_anchor(sets, steps=0)
        least = torch.stack([s.slack(anchor) for s in sets]).amin(0)
        best = chebyshev_center([s.to(torch.float64) for s in sets], share=0.99)
        assert torch.equal(decided, best.slack > 1e-3)
        assert (least >= 0.3 * best.upper_bound)[decided].all()


def test_only_states_left_undecided_are_searched() -> None:
    ball = Ball(t([0.7, 0.0], [1.5, 0.0], [0.0, 0.7], [0.0, 9.0]), t(0.5)[0])
    anchor, decided = attempt_anchor([BOUNDS, ball])
    # The second one can just be touched, the last one is out of reach.
    assert decided.tolist() == [True, False, True, False]
    found = lexicographic_anchor([BOUNDS, ball])
    assert (found.anchor[decided] == anchor[decided]).all()
    assert found.active[:, 1].tolist() == [True, False, True, False]
    check([BOUNDS, ball], found)


def test_the_anchor_does_not_depend_on_the_batch() -> None:
    ball = Ball(torch.randn(60, 2).double(), torch.rand(60).double() * 0.5)
    rows = HalfSpaces(torch.randn(60, 3, 2).double(), torch.randn(60, 3).double() * 0.4)
    found = lexicographic_anchor([BOUNDS, rows, ball])
    assert 0.1 < found.active.double().mean() < 0.95
    for i in range(0, 60, 7):
        index = torch.tensor([i])
        alone = lexicographic_anchor(
            [BOUNDS, *(s.select(torch.Size([60]), index) for s in (rows, ball))]
        )
        torch.testing.assert_close(alone.anchor[0], found.anchor[i], rtol=1e-6, atol=1e-9)
        assert (alone.active[0] == found.active[i]).all()
        torch.testing.assert_close(alone.largest()[0], found.largest()[i], rtol=1e-6, atol=1e-9)


@dataclass(frozen=True, eq=False)
class PlainBall(Ball):
    """A ball that does not describe itself to the search."""

    def superlevel(self) -> None:  # type: ignore[override]
        return None


@pytest.mark.parametrize("dim", [1, 2, 5])
def test_sets_that_only_state_their_slack(dim: int) -> None:
    count = 40
    ones = torch.ones(count, dim, dtype=torch.float64)
    center = 0.7 * torch.randn(2, count, dim, dtype=torch.float64)
    radius = 0.2 + 0.5 * torch.rand(2, count, dtype=torch.float64) * dim**0.5
    known = [Box(-ones, ones), Ball(center[0], radius[0]), Ball(center[1], radius[1])]
    plain = [known[0], PlainBall(center[0], radius[0]), PlainBall(center[1], radius[1])]
    expected, found = chebyshev_center(known), chebyshev_center(plain)
    fits = expected.slack > 0
    assert 0 < fits.double().mean() < 1
    assert (fits == (found.slack > 0)).all()
    assert (found.slack >= expected.slack / 3)[fits].all()
    assert (expected.slack <= found.upper_bound)[fits].all()


@dataclass(frozen=True, eq=False)
class Slab(ConstraintSet):
    """A family that states no more than it must: actions with ``|normal . a| <= width``."""

    normal: Tensor
    width: Tensor

    event_dims: ClassVar[Mapping[str, int]] = {"normal": 1, "width": 0}

    def slack(self, action: Tensor) -> Tensor:
        distance = (self.normal * action).sum(-1).abs()
        return (self.width - distance) / torch.linalg.vector_norm(self.normal, dim=-1)

    def gauge(self, direction: Tensor, anchor: Tensor) -> Tensor:
        along, at = (self.normal * direction).sum(-1), (self.normal * anchor).sum(-1)
        return torch.maximum(along / (self.width - at), -along / (self.width + at))

    def eroded(self, magnitude: Tensor | float = 1.0) -> Slab:
        size = self.width + self.normal.abs().sum(-1) * magnitude
        eps = 16 * torch.finfo(self.dtype).eps
        return Slab(self.normal, self.width - eps * size, validate_args=False)

    def around(self, center: Tensor, radius: Tensor) -> Slab:
        reach = torch.linalg.vector_norm(self.normal, dim=-1) * radius
        return Slab(self.normal, (self.normal * center).sum(-1).abs() + reach, validate_args=False)


def test_a_new_family_needs_five_statements() -> None:
    slab = Slab(t([1.0, 1.0], [1.0, 1.0]), t(0.2, 0.5))
    assert slab.contains(t(0.1, 0.05)).tolist() == [True, True]
    assert slab.contains(t(0.3, 0.1)).tolist() == [False, True]
    assert slab.bounding_box().high.tolist() == [torch.inf, torch.inf]
    corner = box((0.2, 0.2), (1.0, 1.0))
    found = lexicographic_anchor([BOUNDS, slab, corner])
    assert found.active.tolist() == [[True, False, True], [True, True, True]]
    check([BOUNDS, slab, corner], found)
    with pytest.raises(GeometryError, match="Slab, field 'width' at index"):
        Slab(t(1.0, 1.0), t(torch.nan))


def test_a_row_without_a_normal_holds_or_is_dropped() -> None:
    rows = HalfSpaces(t([[0.0, 0.0]], [[0.0, 0.0]], [[1.0, 0.0]]), t([0.0], [-1e-3], [0.5]))
    found = lexicographic_anchor([BOUNDS, rows])
    assert found.active.tolist() == [[True, True], [True, False], [True, True]]
    assert rows.contains(found.anchor).tolist() == [True, False, True]
    check([BOUNDS, rows], found)


def test_upper_bounds_are_tight() -> None:
    sets = [BOUNDS.with_fields(lambda f, _: f.expand(1, 2)), Ball(t([1.0, 0.0]), t(0.8))]
    best = chebyshev_center(sets, share=0.999)
    # On the line from the ball's far end, 0.2, to the bound, 1.
    assert best.slack.item() == pytest.approx(0.4, rel=1e-3)
    assert best.upper_bound.item() == pytest.approx(0.4, rel=1e-3)


def test_the_visible_region_among_other_sets() -> None:
    walls = VisibleRegion.walls(t(-1.0, -1.0), t(1.0, 1.0))
    rectangles = torch.cat([t([[-0.3, -0.3], [0.3, 0.3]]), walls])
    position = t([-0.5, 0.0], [-0.35, 0.1], [0.0, 0.0], [-0.4, -0.4])
    visible = VisibleRegion(position, rectangles, t(0.1)[0])
    nearer = Ball(t([-3.0, 0.0], [-1.0, 0.0], [0.0, 0.0], [0.2, -0.5]), t(2.5, 0.8, 9.0, 0.7))
    for candidate in (None, t([-0.9, 0.0], [-0.9, 0.0], [0.0, 0.0], [0.2, -0.5])):
        for order in ([nearer, visible], [visible, nearer]):
            sets = [BOUNDS, *order]
            found = lexicographic_anchor(sets, candidate)
            # Inside the rectangle nothing is visible; there it is dropped.
            index = 1 + order.index(visible)
            assert found.active[:, index].tolist() == [True, True, False, True]
            assert found.active[:, 3 - index].all()
            check(sets, found)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("distance", [1e3, 1e6, 1e9, 1e12])
def test_sets_far_beyond_the_bounds_are_dropped(distance: float, dtype: torch.dtype) -> None:
    """As good as at infinity: how some say that nothing is allowed. In one batch with others."""
    angles = torch.arange(8, dtype=torch.float64)
    direction = torch.stack([angles.cos(), angles.sin()], -1)
    center = torch.cat([distance * direction, t([0.3, 0.2])])
    radius = t(0.5).expand(9)
    identity = torch.eye(2).double()
    far = (
        Ball(center, radius),
        Ellipsoid(center, (radius[:, None, None] * identity)),
        TaskSpaceBall(identity.expand(9, 2, 2), -center, radius),
    )
    for constraint_set in far:
        sets = [constraint_set.to(dtype) for constraint_set in (BOUNDS, constraint_set)]
        found = lexicographic_anchor(sets)
        assert found.anchor.isfinite().all()
        assert BOUNDS.contains(found.anchor).all()
        assert found.active[..., 1].tolist() == [False] * 8 + [True]
        action = ExactSquash(Region(tuple(sets), *found))(torch.randn(50, 9, 2).to(dtype))
        assert BOUNDS.contains(action).all()


@pytest.mark.parametrize("center", [(0.7, 0.7), (0.5, 0.5), (0.9, -0.9), (0.3, 0.6), (0.9, 0.5)])
@pytest.mark.parametrize("visible_last", [False, True])
def test_what_lies_beside_a_shadow_is_visible(
    center: tuple[float, float], visible_last: bool
) -> None:
    """The side of the rectangle that faces the agent leaves all of these balls out."""
    rectangle = t([[0.3, -0.2], [0.6, 0.1]])
    visible = VisibleRegion(t(0.0, 0.0), rectangle, t(1.0)[0])
    ball = Ball(t(*center), t(0.15)[0])
    sets = [BOUNDS, ball, visible] if visible_last else [BOUNDS, visible, ball]
    found = lexicographic_anchor(sets)
    assert found.active.all()
    assert min(constraint_set.slack(found.anchor) for constraint_set in sets) >= LEAST
    hidden = Ball(t(0.8, -0.05), t(0.1)[0])
    found = lexicographic_anchor([BOUNDS, hidden, visible])
    assert found.active.tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("given", "told"),
    [
        pytest.param(Ball(torch.zeros(3), torch.tensor(1.0)), "Ball of 3 components", id="dim"),
        pytest.param(torch.zeros(2), "Tensor", id="type"),
    ],
)
def test_a_set_that_does_not_fit_the_bounds_is_named(given: ConstraintSet, told: str) -> None:
    for build in (lexicographic_anchor, Region.build):
        with pytest.raises(GeometryError, match=rf"sets\[2\]: .* 2 components.* given {told}"):
            build([BOUNDS, DISC, given])


def test_bounds_are_asked_for() -> None:
    with pytest.raises(GeometryError, match=r"sets\[0\]: expected the Box of action bounds"):
        lexicographic_anchor([DISC])
    endless = Box(t(-torch.inf, -1.0), t(1.0, 1.0))
    with pytest.raises(GeometryError, match="finite Box"):
        lexicographic_anchor([endless, DISC])
    broken = Ball(t(0.0, torch.nan), t(0.5)[0], validate_args=False)
    with pytest.raises(GeometryError, match=r"sets\[1\], field 'center': expected numbers"):
        lexicographic_anchor([BOUNDS, broken])


def test_region_build() -> None:
    region = Region.build([BOUNDS, LEFT, RIGHT])
    assert region.active is not None
    assert region.active.tolist() == [True, False, True]
    assert region.slack(region.anchor) > 1e-3
    # The box that gives way gives way to where the other one begins, and there is room.
    left = region.widened()[1]
    assert isinstance(left, Box)
    assert 0.2 < left.high[0] < 0.21
    assert left.high[1] == 1
    # Without relaxations what does not hold is dropped, and adds nothing.
    dropped = Region(region.sets, region.anchor, region.active)
    gauges = dropped.eroded().gauges(torch.randn(50, 2).double())
    assert (gauges[1] == gauges[0]).all()
    assert (gauges[2] >= gauges[1]).all()
    assert gauges.isfinite().all()
