"""The image's edge on processors that round otherwise, simulated on the one at hand.

Repeated on none: the errors drawn are as large as those between processors.
"""

from __future__ import annotations

import pytest
import torch
from torch.distributions import Independent, Normal

from cnfp_torchrl.bijectors import BallSquash, Projection
from cnfp_torchrl.distributions import ConstrainedFlow
from tests.bijectors.cases import CASES, DTYPES, Case, Maker, latents_of
from tests.bijectors.edges import (
    ALL_DTYPES,
    ALL_EDGES,
    EDGES,
    SATURATED,
    Edge,
    assert_decided_by_one,
    boundary,
)
from tests.bijectors.rounding import OF_SEVERAL_STEPS, RoundedOtherwise


@ALL_DTYPES
@ALL_EDGES
def test_intermediate_results_a_few_units_off(edge: Edge, dtype: torch.dtype) -> None:
    """On processors that round each operation otherwise."""
    # Small and larger errors in turn, so that each kind of bijector meets both in both dtypes.
    most = (1, 4)[(EDGES.index(edge) + DTYPES.index(dtype)) % 2]
    plain = edge.build(dtype)
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
        sample, drawn = flow.rsample_and_log_prob((4_000,))
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
    with RoundedOtherwise():
        projection = Projection(case.region(dtype), rounds=2)
        action = projection(latents_of(case, 50, dtype, (1.0, *SATURATED)))
    assert projection.contains(action).all()
    assert case.allows(action).all()


@pytest.mark.parametrize("edge", EDGES[: len(CASES)], ids=lambda edge: edge.name)
def test_actions_are_allowed_however_they_are_rounded(edge: Edge) -> None:
    """The margin covers what sums and elementary functions differ by from processor to processor.

    Sums, differences, products and quotients of two numbers are the same on all of them.
    """
    with RoundedOtherwise(operations=OF_SEVERAL_STEPS):
        bijector = edge.build(torch.float32)
        actions = bijector(latents_of(edge.case, 30, torch.float32, SATURATED))
    assert edge.case.allows(actions).all()
