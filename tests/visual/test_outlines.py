"""Outlines lie on the boundaries of the sets."""

import itertools

import numpy as np
import pytest
import torch
from matplotlib.path import Path as Polygon

from cnfp_torchrl.geometry import Ball, Box, ConstraintSet, Region, VisibleRegion
from cnfp_torchrl.visual.outlines import Outlines, region_outline, set_outline, within
from tests.visual.cases import CONFLICT, LINE, PLANE, PLANE_OF_OTHERS, SPACE

t = torch.tensor

VIEW = (-1.3, 1.3, -1.3, 1.3)
BOUNDS = Box(-torch.ones(2), torch.ones(2))
EVERY = {**PLANE, **PLANE_OF_OTHERS}


@pytest.mark.parametrize("constraint_set", EVERY.values(), ids=EVERY)
def test_set_outline_is_where_the_slack_is_zero(constraint_set: ConstraintSet) -> None:
    lines = set_outline(constraint_set, VIEW)
    points = torch.tensor(np.concatenate(lines), dtype=torch.float32)
    assert len(points) > 100
    # Linear interpolation in a cell of 2.6 / 400 rounds corners by less than a cell.
    assert constraint_set.slack(points).abs().max() < 2.6 / 400


def test_outline_of_a_ball_is_its_circle() -> None:
    (line,) = set_outline(Ball(torch.tensor([0.2, -0.1]), torch.tensor(0.7)), VIEW)
    distance = np.hypot(line[:, 0] - 0.2, line[:, 1] + 0.1)
    np.testing.assert_allclose(distance, 0.7, atol=1e-4)


def test_set_beyond_the_view_has_no_outline() -> None:
    assert set_outline(Ball(torch.tensor([9.0, 9.0]), torch.tensor(0.5)), VIEW) == []


@pytest.mark.parametrize("sets", [PLANE, PLANE_OF_OTHERS, CONFLICT])
def test_region_outline_is_on_the_edge_of_the_region(sets: dict[str, ConstraintSet]) -> None:
    region = Region.build([BOUNDS, *sets.values()])
    line = torch.tensor(region_outline(region, range(len(region.sets))))
    inwards = region.anchor + (line - region.anchor) * (1 - 1e-4)
    assert region.contains(inwards).all()
    if not any(isinstance(constraint_set, VisibleRegion) for constraint_set in sets.values()):
        # A visible region is seen from the anchor: its outline may stop short of the true set.
        assert not region.contains(region.anchor + (line - region.anchor) * (1 + 1e-4)).any()


def test_region_outline_grows_no_larger_with_each_set() -> None:
    region = Region.build([BOUNDS, *PLANE.values()])
    reach = [
        np.linalg.norm(region_outline(region, range(k + 1)) - region.anchor.numpy(), axis=-1)
        for k in range(len(region.sets))
    ]
    for outer, inner in itertools.pairwise(reach):
        assert (inner <= outer + 1e-9).all()
        assert (inner < outer - 1e-3).any()


def test_shadow_of_a_ball_is_a_disc() -> None:
    ball = Ball(t([0.1, -0.2, 0.3]), t(0.5))
    region = Region(
        (Box(-torch.ones(3), torch.ones(3)), ball), anchor=torch.tensor([0.3, 0.0, 0.0])
    )
    line = region_outline(region, (0, 1))
    distance = np.hypot(line[:, 0] - 0.1, line[:, 1] + 0.2)
    np.testing.assert_allclose(distance, 0.5, atol=2e-3)


def test_shadow_holds_every_point_of_the_region() -> None:
    region = Region.build([Box(-torch.ones(3), torch.ones(3)), *SPACE.values()])
    points = 2 * torch.rand(20_000, 3) - 1
    inside = points[region.contains(points)][:, :2].numpy()
    assert len(inside) > 1000
    shadow = Polygon(region_outline(region, (0, 1, 2)))
    # The outline is one of 720 corners: a chord cuts off some 1e-5.
    assert shadow.contains_points(inside, radius=2e-3).all()


def region_of(sets: dict, dim: int) -> Region:
    return Region.build([Box(-torch.ones(dim), torch.ones(dim)), *sets.values()]).to(torch.float64)


@pytest.mark.parametrize("sets", [PLANE, PLANE_OF_OTHERS], ids=["convex", "others"])
def test_boundaries_have_no_slack(sets: dict) -> None:
    region = region_of(sets, 2)
    outlines = Outlines(region, (0, 1))
    for k, constraint_set in enumerate(region.sets):
        boundary = outlines.of_set(k)
        assert boundary is not None
        near = torch.from_numpy(boundary[np.abs(boundary).max(-1) < 2])
        # A visible region is bounded by the edges of its shadows, too, where its slack is positive.
        least = (
            constraint_set.slack(near).abs()
            if not hasattr(constraint_set, "rectangles")
            else torch.zeros(1)
        )
        assert least.max() < 1e-9
        np.testing.assert_allclose(boundary[0], boundary[-1], atol=1e-9)


def test_intersection_is_the_nearest_boundary() -> None:
    region = region_of(PLANE, 2)
    whole = torch.from_numpy(Outlines(region, (0, 1)).of_intersection((0, 1, 2, 3)))
    torch.testing.assert_close(
        region.slack(whole), torch.zeros(len(whole)).double(), atol=1e-9, rtol=0
    )


def test_corners_of_boxes_are_there() -> None:
    boundary = Outlines(region_of({}, 2), (0, 1)).of_set(0)
    (line,) = within(boundary, (-2, 2, -2, 2))
    corners = {tuple(np.round(point, 9)) for point in line}
    assert {(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)} <= corners
    assert len(line) < 8


def test_dropped_sets_have_no_boundary() -> None:
    outlines = Outlines(region_of(CONFLICT, 2), (0, 1))
    assert outlines.of_set(1) is None
    np.testing.assert_allclose(
        outlines.of_intersection((0, 1, 2)), outlines.of_intersection((0, 2))
    )


def test_intervals_end_where_they_end() -> None:
    outlines = Outlines(region_of(LINE, 1), (0,))
    np.testing.assert_allclose(outlines.of_set(1)[:, 0], [-0.7, 0.4], rtol=1e-6)
    np.testing.assert_allclose(outlines.of_intersection((0, 1, 2))[:, 0], [-0.2, 0.4], rtol=1e-6)


def test_sections_lie_in_the_set() -> None:
    region = region_of(SPACE, 3)
    boundary = Outlines(region, (2, 0)).of_set(1)
    points = region.anchor.expand(len(boundary), 3).clone()
    points[:, [2, 0]] = torch.from_numpy(boundary)
    assert region.sets[1].slack(points).abs().max() < 1e-9


def test_unbounded_sets_are_cut_at_the_view() -> None:
    far = Ball(t([300.0, 0.0]).double(), t(300.5).double())
    region = region_of({"far": far}, 2)
    (line,) = within(Outlines(region, (0, 1)).of_set(1), (-1.1, 1.1, -1.1, 1.1))
    assert np.abs(line).max() <= 1.1 + 1e-12
    np.testing.assert_allclose(sorted(line[[0, -1], 1]), [-1.1, 1.1], rtol=1e-9)
    inner = line[1:-1]
    np.testing.assert_allclose(np.linalg.norm(inner - [300, 0], axis=-1), 300.5, rtol=1e-9)


PIECES = {
    "all inside": ([(0, 0), (1, 0), (1, 1)], [[(0, 0), (1, 0), (1, 1)]]),
    "nothing inside": ([(5, 5), (6, 5)], []),
    "leaves": ([(0, 0), (4, 0)], [[(0, 0), (2, 0)]]),
    "comes back": ([(0, 0), (4, 0), (4, 1), (0, 1)], [[(0, 0), (2, 0)], [(2, 1), (0, 1)]]),
    "straight": ([(0, 0), (0.5, 0.5), (1, 1)], [[(0, 0), (1, 1)]]),
}


@pytest.mark.parametrize("case", PIECES)
def test_pieces_within_a_view(case: str) -> None:
    line, expected = PIECES[case]
    pieces = within(np.array(line, dtype=float), (-2, 2, -2, 2))
    assert len(pieces) == len(expected)
    for piece, wanted in zip(pieces, expected, strict=True):
        np.testing.assert_allclose(piece, wanted)
