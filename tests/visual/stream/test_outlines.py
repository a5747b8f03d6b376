"""Outlines that are quick to draw are those of the sets."""

import numpy as np
import pytest
import torch

from cnfp_torchrl.geometry import Ball, Box, Region
from cnfp_torchrl.visual.stream.outlines import RayOutlines, within
from tests.visual.cases import CONFLICT, LINE, PLANE, PLANE_OF_OTHERS, SPACE

t = torch.tensor


def region_of(sets: dict, dim: int) -> Region:
    return Region.build([Box(-torch.ones(dim), torch.ones(dim)), *sets.values()]).to(torch.float64)


@pytest.mark.parametrize("sets", [PLANE, PLANE_OF_OTHERS], ids=["convex", "others"])
def test_boundaries_have_no_slack(sets: dict) -> None:
    region = region_of(sets, 2)
    outlines = RayOutlines(region, (0, 1))
    for k, each in enumerate(region.sets):
        boundary = outlines.of_set(k)
        assert boundary is not None
        near = torch.from_numpy(boundary[np.abs(boundary).max(-1) < 2])
        # A visible region is bounded by the edges of its shadows, too, where its slack is positive.
        least = each.slack(near).abs() if not hasattr(each, "rectangles") else torch.zeros(1)
        assert least.max() < 1e-9
        np.testing.assert_allclose(boundary[0], boundary[-1], atol=1e-9)


def test_intersection_is_the_nearest_boundary() -> None:
    region = region_of(PLANE, 2)
    whole = torch.from_numpy(RayOutlines(region, (0, 1)).of_intersection((0, 1, 2, 3)))
    torch.testing.assert_close(
        region.slack(whole), torch.zeros(len(whole)).double(), atol=1e-9, rtol=0
    )


def test_corners_of_boxes_are_there() -> None:
    boundary = RayOutlines(region_of({}, 2), (0, 1)).of_set(0)
    (line,) = within(boundary, (-2, 2, -2, 2))
    corners = {tuple(np.round(point, 9)) for point in line}
    assert {(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)} <= corners
    assert len(line) < 8


def test_dropped_sets_have_no_boundary() -> None:
    outlines = RayOutlines(region_of(CONFLICT, 2), (0, 1))
    assert outlines.of_set(1) is None
    np.testing.assert_allclose(
        outlines.of_intersection((0, 1, 2)), outlines.of_intersection((0, 2))
    )


def test_intervals_end_where_they_end() -> None:
    outlines = RayOutlines(region_of(LINE, 1), (0,))
    np.testing.assert_allclose(outlines.of_set(1)[:, 0], [-0.7, 0.4], rtol=1e-6)
    np.testing.assert_allclose(outlines.of_intersection((0, 1, 2))[:, 0], [-0.2, 0.4], rtol=1e-6)


def test_sections_lie_in_the_set() -> None:
    region = region_of(SPACE, 3)
    boundary = RayOutlines(region, (2, 0)).of_set(1)
    points = region.anchor.expand(len(boundary), 3).clone()
    points[:, [2, 0]] = torch.from_numpy(boundary)
    assert region.sets[1].slack(points).abs().max() < 1e-9


def test_unbounded_sets_are_cut_at_the_view() -> None:
    far = Ball(t([300.0, 0.0]).double(), t(300.5).double())
    region = region_of({"far": far}, 2)
    (line,) = within(RayOutlines(region, (0, 1)).of_set(1), (-1.1, 1.1, -1.1, 1.1))
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
