"""Every action lies in every guaranteed set, with zero tolerance, whatever the latent.

Judged on the exact numbers by `reference.contains`, which shares no code with the package.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch

from cnfp_torchrl.bijectors import (
    Bijector,
    BoxSquash,
    ExactSquash,
    GaugeSquash,
    RadialSquash,
    Retraction,
    SquashChain,
)
from cnfp_torchrl.geometry import ConstraintSet, Region
from tests.bijectors import reference
from tests.bijectors.cases import CASES, Case, Maker, cast, latents, latents_of

ids = {"ids": lambda case: case.name}
LENGTHS = (0.0, 1e-40, 1e-12, 1.0, 20.0, 1e6, 1e15)
LONGER = np.finfo(np.longdouble).eps < np.finfo(np.float64).eps


@pytest.mark.parametrize("case", CASES, **ids)
def test_float32_actions_are_allowed(case: Case) -> None:
    bijector = case.build(torch.float32)
    action, log_det = bijector.forward_and_log_det(latents_of(case, 300, torch.float32, LENGTHS))
    assert log_det.isfinite().all()
    assert case.allows(action).all()


@pytest.mark.skipif(not LONGER, reason="NumPy has no number longer than float64 here")
@pytest.mark.parametrize("case", CASES, **ids)
def test_float64_actions_are_allowed(case: Case) -> None:
    bijector = case.build(torch.float64)
    action, log_det = bijector.forward_and_log_det(latents_of(case, 50, torch.float64, LENGTHS))
    assert log_det.isfinite().all()
    assert case.allows(action, np.longdouble).all()


@pytest.mark.parametrize("case", CASES, **ids)
def test_actions_are_allowed_under_autocast(case: Case) -> None:
    """Mixed precision around a policy must not reach the geometry."""
    with torch.autocast("cpu", torch.bfloat16):
        bijector = case.build(torch.float32)
        action = bijector(latents(case, 100, torch.float32, 1e6))
    assert action.dtype == torch.float32
    assert case.allows(action).all()


Build = Callable[[Region], Bijector]
Family = Callable[[Maker], ConstraintSet]
FAMILIES: tuple[Family, ...] = (
    Maker.ball,
    Maker.large_ball,
    Maker.box,
    Maker.ellipsoid,
    Maker.half_spaces,
    Maker.weighted_l1,
    Maker.positive_part,
    lambda make: make.ball(73.0),
    Maker.open_box,
)


def violations(build: Build, make: Maker, families: tuple[Family, ...], lengths: tuple) -> int:
    """Count float32 actions outside random regions, one latent of each length for each region."""
    return violations_of(build, make, [family(make) for family in families], lengths)


def violations_of(
    build: Build, make: Maker, constraints: Sequence[ConstraintSet], lengths: tuple
) -> int:
    sets = (make.bounds(), *constraints)
    single = tuple(cast(constraint_set, torch.float32) for constraint_set in sets)
    bijector = build(Region(single, make.anchor.float()))
    case = Case("", "gauge", sets, make.anchor)
    action, log_det = bijector.forward_and_log_det(latents_of(case, 1, torch.float32, lengths))
    inside = np.logical_and.reduce(
        [reference.contains(constraint_set, action) for constraint_set in sets]
    )
    return int((~inside).sum()) + int((~log_det.isfinite()).sum())


@pytest.mark.parametrize("build", [GaugeSquash, RadialSquash])
@pytest.mark.parametrize("dim", [1, 2, 3, 6, 32])
@pytest.mark.parametrize("slack", [1e-4, 1e-2])
def test_random_regions_are_never_left(build: Build, dim: int, slack: float) -> None:
    """1,060,000 float32 actions in 177,000 regions, half of them about to touch a boundary."""
    regions = 400 if dim == 32 else 3500
    for seed, size in enumerate((1e-3, 1.0, 1e3)):
        for number in range(2):
            make = Maker(dim, (regions,), size=size, slack=slack, offset=seed, seed=seed)
            chosen = torch.randperm(len(FAMILIES), generator=make.random)[: 1 + 2 * number]
            families = tuple(FAMILIES[i] for i in chosen)
            assert violations(build, make, families, LENGTHS[1:]) == 0


@pytest.mark.parametrize("build", [ExactSquash, GaugeSquash, RadialSquash])
@pytest.mark.parametrize("dim", [1, 2, 6, 32])
def test_rounding_sets_to_float32_stays_within_their_margin(build: Build, dim: int) -> None:
    """Sets of float64 numbers that float32 does not hold, as observations of float64 make them."""
    for family in (*FAMILIES, Maker.task_space_ball):
        for size in (1e-3, 1.0, 1e3):
            make = Maker(dim, (500,), size=size, slack=1e-3, offset=2.0, seed=dim)

            def unrounded(field: torch.Tensor, _: int, make: Maker = make) -> torch.Tensor:
                change = torch.rand(field.shape, generator=make.random, dtype=torch.float64)
                return field * (1 + 5e-8 * (2 * change - 1))

            exact = family(make).with_fields(unrounded)
            assert not (exact.to(torch.float32).to(torch.float64).slack(make.anchor) < 0).any()
            assert violations_of(build, make, [exact], (1.0, 20.0, 1e6)) == 0


def retraction(region: Region) -> Bijector:
    outer, inner = region.sets
    squash = BoxSquash(region.bounds.low, region.bounds.high)
    return SquashChain([squash, Retraction(outer, inner, region.anchor)])


@pytest.mark.parametrize("build", [GaugeSquash, retraction])
def test_a_bound_beside_the_anchor_does_not_stretch_rounding_errors(build: Build) -> None:
    """A saturated tanh that misses its bound by one rounding error must not cost a multiple of it.

    With the anchor 1e-4 beside a bound, that error is a large share of the way to the bound; the
    flow once carried this share over to the whole way to the ball's boundary, far along the bound.
    """
    for dim in (2, 3, 6):
        make = Maker(dim, (4000,), slack=1e-4, offset=3.0, seed=dim)
        assert violations(build, make, (Maker.large_ball,), (20.0, 1e6)) == 0
