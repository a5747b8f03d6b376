"""Bijectors with the edges of their images, where one computation must decide what is inside."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor
from torch.distributions import Independent, Normal

from cnfp_torchrl.bijectors import Bijector, Retraction, ShellSquash
from cnfp_torchrl.distributions import ConstrainedFlow
from cnfp_torchrl.geometry import Box, HalfSpaces, Region
from tests.bijectors.cases import CASES, DTYPES, Case, Maker, cast, latents_of

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


def boundary(edge: Edge, bijector: Bijector, dtype: torch.dtype, count: int = 6) -> Tensor:
    """Return saturated samples, those nearly so, and points on the sets' own boundaries."""
    z = latents_of(edge.case, count, dtype, SATURATED)
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
