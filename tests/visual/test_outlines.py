"""Outlines lie on the boundaries of the sets."""

import itertools

import numpy as np
import pytest
import torch
from matplotlib.path import Path as Polygon

from cnfp_torchrl.geometry import Ball, Box, ConstraintSet, Region, VisibleRegion
from cnfp_torchrl.visual.outlines import interval, region_outline, set_outline
from tests.visual.cases import CONFLICT, LINE, PLANE, PLANE_OF_OTHERS, SPACE

VIEW = (-1.3, 1.3, -1.3, 1.3)
BOUNDS = Box(-torch.ones(2), torch.ones(2))
EVERY = {**PLANE, **PLANE_OF_OTHERS}


@pytest.mark.parametrize("each", EVERY.values(), ids=EVERY)
def test_set_outline_is_where_the_slack_is_zero(each: ConstraintSet) -> None:
    lines = set_outline(each, VIEW)
    points = torch.tensor(np.concatenate(lines), dtype=torch.float32)
    assert len(points) > 100
    # Linear interpolation in a cell of 2.6 / 400 rounds corners by less than a cell.
    assert each.slack(points).abs().max() < 2.6 / 400


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
    if not any(isinstance(each, VisibleRegion) for each in sets.values()):
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
    ball = Ball(torch.tensor([0.1, -0.2, 0.3]), torch.tensor(0.5))
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


def test_interval_of_one_component() -> None:
    region = Region.build([Box(-torch.ones(1), torch.ones(1)), *LINE.values()])
    assert interval(region, (0,)) == pytest.approx((-1, 1))
    assert interval(region, (0, 1)) == pytest.approx((-0.7, 0.4))
    assert interval(region, (0, 1, 2)) == pytest.approx((-0.2, 0.4))
