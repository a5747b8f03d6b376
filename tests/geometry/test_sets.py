"""Properties of every family of sets, over the table of `cases`."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cnfp_torchrl.geometry import Box, Region
from tests.geometry.cases import CASES, DTYPES, Case

pytestmark = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)


def test_gauge_is_where_the_ray_leaves(case: Case) -> None:
    last = 100.0 if "huge" in case.name else 16.0
    for anchor in case.anchors(torch.float64):
        way = case.directions(8, torch.float64)
        gauge = case.sets.gauge(way, anchor)
        leaves = gauge > 1 / last
        assert leaves.any()
        exit = anchor + way / gauge.clamp(min=1 / last).unsqueeze(-1)
        # Every point before it is inside and the next one outside; so that a part of the set which
        # the ray meets again later does not matter, however short the way between is.
        for share in torch.linspace(0, 1 - 1e-8, 1001, dtype=torch.float64):
            assert case.sets.contains(anchor + (exit - anchor) * share).all()
        assert not case.sets.contains(anchor + (exit - anchor) * (1 + 1e-8))[leaves].any()


def test_gauge_is_positively_homogeneous(case: Case) -> None:
    for dtype in DTYPES:
        sets, anchor = case.cast(dtype), case.anchors(dtype)[1]
        way = case.directions(40, dtype)
        # Powers of two, so that float32 must agree but for squares that leave its range.
        for scale in (2.0**-12, 2.0**10):
            gauge = sets.gauge(way * scale, anchor)
            torch.testing.assert_close(gauge, scale * sets.gauge(way, anchor), rtol=1e-5, atol=0)


def test_boundary_has_no_slack(case: Case) -> None:
    for anchor in case.anchors(torch.float64):
        way = case.directions(200, torch.float64)
        gauge = case.sets.gauge(way, anchor)
        boundary = anchor + way / gauge.clamp(min=1e-3).unsqueeze(-1)
        slack = case.sets.slack(boundary)
        reach = 1e-9 * (case.size + boundary.abs().amax(-1))
        assert (slack.abs() <= reach)[gauge > 1e-3].all()
        assert (slack >= -reach).all()


def test_slack_tells_inside_from_outside_and_bounds_the_distance(case: Case) -> None:
    for anchor in case.anchors(torch.float64):
        action = (
            anchor
            + case.directions(100, torch.float64) * torch.rand(100, *anchor.shape[:-1], 1) * 3
        )
        slack = case.sets.slack(action)
        clear = slack.abs() > 1e-9 * case.size
        inside = case.sets.contains(action)
        assert ((slack > 0) == inside)[clear].all()
        # Nothing nearer than the slack is on the other side, also not straight ahead.
        action = action.requires_grad_()
        steepest = torch.autograd.grad(case.sets.slack(action).nan_to_num().sum(), action)[0]
        # But for rounding error of all that is of the size of the set, or of the actions.
        rounding = 1e-12 * (case.size + action.detach().abs().amax(-1))
        reach = (slack.abs().clamp(max=1e3 * case.size) - rounding).clamp(min=0).unsqueeze(-1)
        for way in (*case.directions(6, torch.float64), steepest, -steepest):
            length = torch.linalg.vector_norm(way, dim=-1, keepdim=True)
            near = action.detach() + way / torch.where(length > 0, length, 1.0) * reach
            assert (case.sets.contains(near) == inside)[clear].all()


def test_slack_is_concave_in_convex_sets(case: Case) -> None:
    if not case.convex:
        pytest.skip("the visible region is not convex")
    one = case.inside + 2 * case.directions(500, torch.float64)
    other = case.inside + 2 * case.directions(500, torch.float64).flip(0)
    share = torch.rand(500, *case.inside.shape[:-1], dtype=torch.float64)
    slack = case.sets.slack
    between = one + (other - one) * share.unsqueeze(-1)
    chord = slack(one) + (slack(other) - slack(one)) * share
    chord = torch.where(slack(one).isinf(), -torch.inf, chord)
    assert (slack(between) >= chord - 1e-9 * case.size * (1 + chord.abs())).all()


def test_bounding_box_holds_the_set(case: Case) -> None:
    box = Box(*case.sets.bounding_box(), validate_args=False)
    assert torch.broadcast_shapes(box.batch_shape, case.sets.batch_shape) == case.sets.batch_shape
    for anchor in case.anchors(torch.float64):
        way = case.directions(400, torch.float64)
        gauge = case.sets.gauge(way, anchor)
        boundary = anchor + way / gauge.clamp(min=1e-3).unsqueeze(-1)
        assert (box.slack(boundary) >= -1e-9 * (case.size + boundary.abs().amax(-1))).all()


@pytest.mark.parametrize("dtype", DTYPES)
def test_points_of_the_eroded_set_lie_in_the_set(case: Case, dtype: torch.dtype) -> None:
    bounds = case.bounds.with_fields(lambda field, _: field.to(dtype))
    sets = case.cast(dtype)
    way = case.directions(2000 if case.sets.dim <= 6 else 300, dtype)
    for anchor in case.anchors(dtype):
        region = Region((bounds, sets), anchor).eroded()
        _, gauge = region.outer_and_inner_gauge(way)
        assert (gauge > 0).all()
        for action in (
            anchor + way / gauge.unsqueeze(-1),
            anchor + way * (1 / gauge).unsqueeze(-1),
            anchor + (anchor + 3 * way - anchor) * (1 / (3 * gauge)).unsqueeze(-1),
        ):
            assert case.sets.contains(action).all()
            assert case.bounds.contains(action).all()


def test_gradients_of_the_gauge_are_those_of_finite_differences(case: Case) -> None:
    way = torch.randn_like(case.inside) * case.size
    anchor = case.inside + 0.5 * way / case.sets.gauge(way, case.inside).clamp(min=1).unsqueeze(-1)
    way = torch.randn_like(case.inside) * case.size
    fields = case.sets.fields()
    values = {"way": way, "anchor": anchor, **fields}
    # Differentiate by the logarithm of a factor of each, as sizes differ by 1e6. The zeros above a
    # triangular matrix's diagonal stay zero.
    logs = [torch.zeros_like(value).requires_grad_() for value in values.values()]

    def gauge(*logs: Tensor) -> Tensor:
        moved = {
            name: torch.where(value.isfinite(), value.nan_to_num() * log.exp(), value)
            for (name, value), log in zip(values.items(), logs, strict=True)
        }
        sets = type(case.sets)(**{name: moved[name] for name in fields}, validate_args=False)
        return sets.gauge(moved["way"], moved["anchor"])

    assert torch.autograd.gradcheck(gauge, logs, fast_mode=True, eps=1e-7, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("dtype", DTYPES)
def test_gradients_are_finite(case: Case, dtype: torch.dtype) -> None:
    sets = case.cast(dtype)
    for anchor in case.anchors(dtype):
        way = case.directions(400, dtype).requires_grad_()
        middle = anchor.clone().requires_grad_()
        gauge = sets.gauge(way, middle)
        assert gauge.isfinite().all()
        for gradient in torch.autograd.grad(gauge.sum(), (way, middle)):
            assert gradient.isfinite().all()


def test_around_has_the_fields_shapes_and_contains_the_ball(case: Case) -> None:
    anchor = 5 * torch.randn(*case.inside.shape, dtype=torch.float64)
    radius = torch.tensor(3.0, dtype=torch.float64)
    around = case.sets.around(anchor, radius)
    around.validate()
    way = case.directions(100, torch.float64)
    on_sphere = anchor + (1 - 1e-9) * radius * way / way.norm(dim=-1, keepdim=True)
    assert around.contains(on_sphere).all()
    nowhere = torch.zeros(case.sets.batch_shape, dtype=torch.bool)
    dropped = case.sets.unless_dropped(nowhere, anchor, radius)
    assert dropped.contains(on_sphere).all()
    kept = case.sets.unless_dropped(~nowhere, anchor, radius)
    assert (kept.slack(case.inside) == case.sets.slack(case.inside)).all()
    mixed = case.sets.where(nowhere, around)
    for name, field in case.sets.fields().items():
        event = case.sets.event_dims[name]
        given = mixed.fields()[name]
        assert given.shape[given.ndim - event :] == field.shape[field.ndim - event :]
    way = case.directions(10, torch.float64).requires_grad_()
    for each in (mixed, dropped):
        gauge = each.gauge(way, anchor)
        assert gauge.isfinite().all()
        assert torch.autograd.grad(gauge.sum(), way)[0].isfinite().all()


def test_batch_elements_do_not_mix(case: Case) -> None:
    batch = case.sets.batch_shape
    way = case.directions(5, torch.float64)
    whole = case.sets.gauge(way, case.inside), case.sets.slack(case.inside)
    way, inside = (x.expand(*x.shape[:-1], -1) for x in (way, case.inside))
    for i in range(batch.numel()):
        one = case.sets.select(batch, torch.tensor([i]))
        along = way.reshape(5, -1, way.shape[-1])[:, i : i + 1]
        at = inside.reshape(-1, inside.shape[-1])[i : i + 1]
        torch.testing.assert_close(one.gauge(along, at), whole[0].reshape(5, -1)[:, i : i + 1])
        torch.testing.assert_close(one.slack(at), whole[1].reshape(-1)[i : i + 1])
