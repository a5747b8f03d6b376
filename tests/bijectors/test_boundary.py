"""At the image's edge one computation decides, however a processor rounds.

An action either has a finite latent and a finite density, or it lies outside and its density is 0.
Nothing is NaN or +inf, on the boundary, beside it, and with errors of a few units in the last place
in the actions and in the sets' numbers; in intermediate results, see `test_other_processors`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cnfp_torchrl.distributions import ConstrainedFlow
from tests.bijectors.cases import latents
from tests.bijectors.edges import (
    ALL_DTYPES,
    ALL_EDGES,
    Edge,
    assert_decided_by_one,
    boundary,
    gaussian,
)
from tests.bijectors.rounding import moved, moved_at_random

ULPS = (1, 2, 8)


def around(points: Tensor) -> Tensor:
    """Return points and their neighbors a few units in the last place away, in all directions."""
    random = torch.Generator().manual_seed(1)
    neighbors = [points]
    for ulps in ULPS:
        signs = torch.randint(0, 2, points.shape, generator=random) * 2 - 1
        for steps in (ulps, -ulps, ulps * signs):
            neighbors.append(moved(points, steps))
        neighbors.append(moved_at_random(points, ulps, random))
    return torch.cat(neighbors)


@ALL_DTYPES
@ALL_EDGES
def test_neighbors_of_the_boundary(edge: Edge, dtype: torch.dtype) -> None:
    bijector = edge.build(dtype)
    actions = around(boundary(edge, bijector, dtype))
    assert len(actions) > 100
    assert_decided_by_one(edge, bijector, actions)


@ALL_DTYPES
@ALL_EDGES
def test_sets_a_few_units_off(edge: Edge, dtype: torch.dtype) -> None:
    """Radii, bounds, weights and matrices, as another processor may have computed them."""
    points = boundary(edge, edge.build(dtype), dtype)
    random = torch.Generator().manual_seed(2)
    for ulps in (1, 16):
        bijector = edge.build(dtype, lambda field, ulps=ulps: off(field, ulps, random))
        assert_decided_by_one(edge, bijector, points)


def off(field: Tensor, ulps: int, random: torch.Generator) -> Tensor:
    """Return a field a few units off, with its zeros, which have meanings of their own."""
    return torch.where(field == 0, field, moved_at_random(field, ulps, random))


@ALL_EDGES
def test_actions_outside_leave_gradients_finite(edge: Edge) -> None:
    """The density's gradient comes from actions inside; one outside must not spoil the others."""
    bijector = edge.build(torch.float32)
    base, parameters = gaussian(edge.case, torch.float32)
    one = torch.full((1, *edge.case.batch_shape, edge.case.dim), edge.case.size)
    far = torch.cat([one * size for size in (0.0, 1.0, 30.0, torch.inf)])
    actions = torch.cat([far, -far, bijector(latents(edge.case, 4, torch.float32, 0.5))])
    actions.requires_grad_()
    log_prob = ConstrainedFlow(base, bijector).log_prob(actions)
    for gradient in torch.autograd.grad(
        log_prob[log_prob.isfinite()].sum(), (actions, *parameters)
    ):
        assert gradient.isfinite().all()
