"""At the image's edge one computation decides, however a processor rounds.

An action either has a finite latent and a finite density, or it lies outside and its density is 0.
Nothing is NaN or +inf, on the boundary, beside it, and with errors of a few units in the last place
in the actions, in the sets' numbers and in every intermediate result.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor
from torch.distributions import Independent, Normal

from cnfp_torchrl.bijectors import BallSquash, Bijector, Projection, Retraction, ShellSquash
from cnfp_torchrl.distributions import ConstrainedFlow
from cnfp_torchrl.geometry import Box, HalfSpaces, Region
from tests.bijectors.cases import CASES, DTYPES, Case, Maker, cast, latents
from tests.bijectors.rounding import OF_SEVERAL_STEPS, RoundedOtherwise, moved, moved_at_random

ULPS = (1, 2, 3, 8)
SATURATED = (5.0, 8.0, 9.0, 12.0, 20.0, 30.0, 1e6)
"""Lengths of latents about which tanh reaches 1 in float32, in float64, and beyond."""


@dataclass(frozen=True)
class Edge:
    """A bijector whose boundary is looked at.

    Args:
        name: The name for the test's id.
        case: Its dimension, its batch and the size of its numbers.
        make: The bijector, of sets whose numbers are changed by a function of them.
    """

    name: str
    case: Case
    make: Callable[[torch.dtype, Callable[[Tensor], Tensor]], Bijector]

    def build(
        self, dtype: torch.dtype, change: Callable[[Tensor], Tensor] = lambda field: field
    ) -> Bijector:
        return self.make(dtype, change)


def of_table(case: Case) -> Edge:
    def make(dtype: torch.dtype, change: Callable[[Tensor], Tensor]) -> Bijector:
        # Rounded before they are changed, as `Case.build` does.
        sets = tuple(
            constraint_set.with_fields(lambda field, _: change(field.to(dtype)).to(field))
            for constraint_set in case.sets
        )
        return Case(case.name, case.kind, sets, case.anchor, case.active).build(dtype)

    return Edge(case.name, case, make)


def shell(dim: int, *, with_region: bool) -> Edge:
    center, ones = torch.full((dim,), 0.1).double(), torch.ones(dim).double()
    cut = HalfSpaces(ones.unsqueeze(0), torch.tensor([dim * 0.1 + 0.5]).double())

    def make(dtype: torch.dtype, change: Callable[[Tensor], Tensor]) -> Bijector:
        region = None
        if with_region:
            region = Region((cast(Box(-ones, ones), dtype), cast(cut, dtype)), center.to(dtype))
        inner, outer = (change(torch.tensor(radius, dtype=dtype)) for radius in (0.3, 1.2))
        return ShellSquash(center.to(dtype), inner, outer, region)

    name = f"shell-{'region-' if with_region else ''}d{dim}"
    return Edge(name, Case(name, "squash", (Box(-2 * ones, 2 * ones),)), make)


def lone_retraction() -> Edge:
    """Not behind a squash, from the box that is its domain."""
    make = Maker(2, seed=40)
    case = Case("lone-retraction-d2", "retraction", (make.bounds(), make.ball()), make.anchor)

    def build(dtype: torch.dtype, change: Callable[[Tensor], Tensor]) -> Bijector:
        outer, inner = case.cast(dtype)
        inner = inner.with_fields(lambda field, _: change(field))
        return Retraction(outer, inner, make.anchor.to(dtype))

    return Edge(case.name, case, build)


EDGES = (
    *(of_table(case) for case in CASES),
    *(shell(dim, with_region=with_region) for dim in (1, 2, 6) for with_region in (False, True)),
    lone_retraction(),
)
ALL_EDGES = pytest.mark.parametrize("edge", EDGES, ids=lambda edge: edge.name)
ALL_DTYPES = pytest.mark.parametrize("dtype", DTYPES, ids=str)


def boundary(edge: Edge, bijector: Bijector, dtype: torch.dtype, count: int = 10) -> Tensor:
    """Return saturated samples, those nearly so, and points on the sets' own boundaries."""
    z = torch.cat([latents(edge.case, count, dtype, length) for length in SATURATED])
    reached = bijector(z)
    if edge.name.startswith("lone"):
        outer, _ = edge.case.cast(dtype)
        assert isinstance(outer, Box)
        reached = bijector(outer.low + (outer.high - outer.low) * (0.5 + 0.5 * z.sign()))
    box = edge.case.cast(dtype)[-1].bounding_box()
    corners = torch.where(z > 0, box.high, box.low)
    faces = torch.where(z.abs() == z.abs().amax(-1, keepdim=True), corners, reached)
    points = torch.cat([reached, corners, faces])
    # A box may be open, and where a shell's ray has no room its action is NaN by contract.
    return points[points.isfinite().flatten(1).all(-1)]


def around(points: Tensor) -> Tensor:
    """Return points and their neighbours a few units in the last place away, in all directions."""
    random = torch.Generator().manual_seed(1)
    neighbours = [points]
    for ulps in ULPS:
        signs = torch.randint(0, 2, points.shape, generator=random) * 2 - 1
        for steps in (ulps, -ulps, ulps * signs):
            neighbours.append(moved(points, steps))
        neighbours.append(moved_at_random(points, ulps, random))
    return torch.cat(neighbours)


def gaussian(case: Case, dtype: torch.dtype) -> tuple[Independent, tuple[Tensor, Tensor]]:
    loc = torch.full((*case.batch_shape, case.dim), 0.1, dtype=dtype, requires_grad=True)
    scale = torch.full_like(loc, 0.7).requires_grad_()
    return Independent(Normal(loc, scale), 1), (loc, scale)


def assert_decided_by_one(
    edge: Edge, bijector: Bijector, actions: Tensor, *, repeatable: bool = True
) -> None:
    """Check that each action is either inside with a density, or outside, in every answer."""
    base, parameters = gaussian(edge.case, actions.dtype)
    flow = ConstrainedFlow(base, bijector)
    actions = actions.detach().requires_grad_()
    log_prob = flow.log_prob(actions)
    assert not log_prob.isnan().any()
    assert (log_prob < torch.inf).all()
    scored = log_prob[log_prob.isfinite()].sum()
    of_actions, *of_parameters = torch.autograd.grad(scored, (actions, *parameters))
    assert all(gradient.isfinite().all() for gradient in of_parameters)
    # Behind errors that are drawn anew, two runs of one computation may differ.
    if repeatable:
        assert of_actions.isfinite().all()
        inside = bijector.contains(actions)
        latent, log_det = bijector.inverse_and_log_det(actions)
        assert torch.equal(latent.isfinite().all(-1), inside)
        assert log_det[inside].isfinite().all()
        assert torch.equal(log_prob.isfinite(), inside)
        assert torch.equal(flow.support.check(actions), inside)


@ALL_DTYPES
@ALL_EDGES
def test_neighbours_of_the_boundary(edge: Edge, dtype: torch.dtype) -> None:
    bijector = edge.build(dtype)
    actions = around(boundary(edge, bijector, dtype))
    assert len(actions) > 100
    assert_decided_by_one(edge, bijector, actions)


@ALL_DTYPES
@ALL_EDGES
def test_sets_a_few_units_off(edge: Edge, dtype: torch.dtype) -> None:
    """Radii, bounds, weights and matrices, as another processor may have computed them."""
    points = boundary(edge, edge.build(dtype), dtype, 6)
    random = torch.Generator().manual_seed(2)
    for ulps in (1, 4, 16):
        bijector = edge.build(dtype, lambda field, ulps=ulps: off(field, ulps, random))
        assert_decided_by_one(edge, bijector, points)


def off(field: Tensor, ulps: int, random: torch.Generator) -> Tensor:
    """Return a field a few units off, with its zeros, which have meanings of their own."""
    return torch.where(field == 0, field, moved_at_random(field, ulps, random))


@ALL_DTYPES
@ALL_EDGES
def test_intermediate_results_a_few_units_off(edge: Edge, dtype: torch.dtype) -> None:
    """On processors that round each operation otherwise."""
    plain = edge.build(dtype)
    for most in (1, 4):
        with RoundedOtherwise(most) as processor:
            bijector = edge.build(dtype)
            points = boundary(edge, bijector, dtype)
            assert_decided_by_one(edge, bijector, points, repeatable=False)
        # Made on one processor and judged on another.
        assert_decided_by_one(edge, plain, points)
        assert len(processor.seen) > 3


@pytest.mark.parametrize("most", [0, 1, 3])
@ALL_DTYPES
@pytest.mark.parametrize("dim", [1, 2, 3, 6])
def test_a_saturated_ball(dim: int, dtype: torch.dtype, most: int) -> None:
    """Most samples of a wide Gaussian round to the boundary, where |p|^2 and |p| round apart."""
    with RoundedOtherwise(most):
        squash = BallSquash(torch.zeros(dim, dtype=dtype), torch.tensor(1.0, dtype=dtype))
        wide = torch.zeros(dim, dtype=dtype)
        flow = ConstrainedFlow(Independent(Normal(wide, wide + 30), 1), squash)
        sample, drawn = flow.rsample_and_log_prob((20_000,))
        # Of a copy, because the density of the very draw is that of its latent.
        log_prob = flow.log_prob(sample.clone())
    assert drawn.isfinite().all()
    assert not log_prob.isnan().any()
    assert (log_prob < torch.inf).all()
    assert log_prob.isinf().any()


@ALL_DTYPES
@pytest.mark.parametrize("dim", [1, 2, 6])
def test_a_projection_contains_its_actions(dim: int, dtype: torch.dtype) -> None:
    """Its boundary belongs to its image, and its margin is wider than what processors differ by."""
    make = Maker(dim, (40,), slack=0.05, seed=dim)
    case = Case("", "projection", (make.bounds(), make.ball(), make.half_spaces()), make.anchor)
    for length in (1.0, *SATURATED):
        with RoundedOtherwise():
            projection = Projection(case.region(dtype), rounds=2)
            action = projection(latents(case, 50, dtype, length))
        assert projection.contains(action).all()
        assert case.allows(action).all()


@pytest.mark.parametrize("edge", EDGES[: len(CASES)], ids=lambda edge: edge.name)
def test_actions_are_allowed_however_they_are_rounded(edge: Edge) -> None:
    """The margin covers what sums and elementary functions differ by from processor to processor.

    Sums, differences, products and quotients of two numbers are the same on all of them.
    """
    with RoundedOtherwise(operations=OF_SEVERAL_STEPS):
        bijector = edge.build(torch.float32)
        actions = [bijector(latents(edge.case, 30, torch.float32, size)) for size in SATURATED]
    assert edge.case.allows(torch.cat(actions)).all()


@pytest.mark.parametrize("size", [0.0, 1.0, 30.0, torch.inf])
@ALL_EDGES
def test_actions_outside_leave_gradients_finite(edge: Edge, size: float) -> None:
    """The density's gradient comes from actions inside; one outside must not spoil the others."""
    bijector = edge.build(torch.float32)
    base, parameters = gaussian(edge.case, torch.float32)
    shape = (4, *edge.case.batch_shape, edge.case.dim)
    far = torch.full(shape, size * edge.case.size)
    actions = torch.cat([far, -far, bijector(latents(edge.case, 4, torch.float32, 0.5))])
    actions.requires_grad_()
    log_prob = ConstrainedFlow(base, bijector).log_prob(actions)
    for gradient in torch.autograd.grad(
        log_prob[log_prob.isfinite()].sum(), (actions, *parameters)
    ):
        assert gradient.isfinite().all()
