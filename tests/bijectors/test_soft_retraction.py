"""What soft retractions promise beyond all bijectors: sharpness, unbounded sets, the inverse."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from mpmath import mp, mpf
from torch import Tensor

from cnfp_torchrl.bijectors import SoftRetraction, SoftSquash
from cnfp_torchrl.bijectors.soft_retraction import soft_factor
from cnfp_torchrl.geometry import Ball, Box, HalfSpaces, Region
from tests.bijectors import reference
from tests.bijectors.cases import CASES, DTYPES, Case, Maker, cast, latents
from tests.bijectors.numeric import log_abs_det
from tests.bijectors.test_inside import FAMILIES, LONGER, violations

SHARPNESSES = (1.0, 1.5, 2.0, 4.0, 16.0, 100.0)
LENGTHS = (1e-12, 1.0, 20.0, 1e3, 1e6, 1e15, 1e30)
SATURATING = [case for case in CASES if case.kind.startswith("soft")]


@pytest.mark.parametrize("sharpness", SHARPNESSES)
@pytest.mark.parametrize("build", [SoftSquash, SoftRetraction])
def test_random_regions_are_never_left(build: Callable, sharpness: float) -> None:
    """Divisors from 1 to 1e4 and more, progress from 0 to 1, latents up to 1e30, in float32."""
    for seed, dim in enumerate((1, 2, 6)):
        for slack in (1e-4, 1e-2):
            make = Maker(dim, (500,), slack=slack, offset=seed, seed=seed)
            chosen = torch.randperm(len(FAMILIES), generator=make.random)[:3]
            families = tuple(FAMILIES[i] for i in chosen)

            def soft(region: Region) -> SoftSquash | SoftRetraction:
                return build(region, sharpness=sharpness)

            assert violations(soft, make, families, LENGTHS) == 0


@pytest.mark.skipif(not LONGER, reason="NumPy has no number longer than float64 here")
@pytest.mark.parametrize("sharpness", SHARPNESSES)
@pytest.mark.parametrize("build", [SoftSquash, SoftRetraction])
def test_divisors_of_1e8_in_float64(build: Callable, sharpness: float) -> None:
    make = Maker(2, (100,), slack=1e-8, seed=3)
    sets = (make.bounds(), make.ball(), make.half_spaces())
    bijector = build(Region(sets, make.anchor), sharpness=sharpness)
    case = Case("", "soft", sets, make.anchor)
    for length in LENGTHS:
        action, log_det = bijector.forward_and_log_det(latents(case, 20, torch.float64, length))
        assert log_det.isfinite().all()
        for constraint_set in sets:
            assert reference.contains(constraint_set, action, np.longdouble).all()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("sharpness", SHARPNESSES)
def test_factors_match_mpmath_over_their_whole_range(dtype: torch.dtype, sharpness: float) -> None:
    """Divisors r from 1 to 1e8 (float32) and 1e30 (float64), at any progress q, and q = 0."""
    eps, most = torch.finfo(dtype).eps, 8 if dtype == torch.float32 else 30
    ratio = torch.logspace(0, most, 40, dtype=dtype).unsqueeze(-1)
    progress = torch.tensor([0, 1e-30, 1e-12, 1e-6, 0.01, 0.5, 0.99, 1 - 8 * eps, 1.0], dtype=dtype)
    gauge = ratio * progress
    factor, log_u = soft_factor(progress.expand_as(gauge), gauge, sharpness)
    p = mpf(sharpness)
    given = (_flat(x) for x in (progress.expand_as(gauge), gauge, factor, log_u))
    for q, g, f, log in zip(*given, strict=True):
        u = 1 + g**p - q**p
        assert abs(f * u ** (1 / p) - 1) <= 6 * eps
        assert abs(log - mp.log(u)) <= 6 * eps * max(1, sharpness) * (1 + abs(mp.log(u)))
        assert f * g <= 1 + 6 * eps


def _flat(value: Tensor) -> list[mpf]:
    return [mpf(value) for value in value.double().flatten().tolist()]


@pytest.mark.parametrize("case", SATURATING, ids=lambda case: case.name)
@pytest.mark.parametrize("dtype", DTYPES)
def test_the_inverse_is_right_up_to_rounding_before_the_boundary(
    case: Case, dtype: torch.dtype
) -> None:
    bijector, eps = case.build(dtype), torch.finfo(dtype).eps
    for progress in (1e-6, 0.1, 0.9, 1 - 1e-3, 1 - 64 * eps * case.tightness):
        direction = torch.randn(50, *case.batch_shape, case.dim, dtype=dtype)
        gauge = bijector.region.gauges(direction)[-1].unsqueeze(-1)
        action = bijector.region.anchor + direction / gauge * min(
            progress, 1 - 64 * eps * case.tightness
        )
        assert bijector.contains(action).all()
        latent, log_det = bijector.inverse_and_log_det(action)
        assert latent.isfinite().all()
        assert log_det.isfinite().all()
        error = (bijector(latent) - action).abs().amax(-1)
        assert error.max() <= 8 * eps * case.size


@pytest.mark.parametrize("by_components", [True, False])
def test_what_nothing_binds_is_left_alone(by_components: bool) -> None:
    """About an anchor the map is the identity, to second order for p = 2, and never steeper."""
    make = Maker(2, (8,), seed=5)
    region = Region((make.bounds(), make.ball(), make.half_spaces()), make.anchor)
    soft = SoftRetraction(region, sharpness=2, by_components=by_components)
    direction = torch.randn(20, 8, 2, dtype=torch.float64)
    direction = direction / direction.norm(dim=-1, keepdim=True)
    for length in (1e-9, 1e-4, 1e-2):
        point = make.anchor + length * direction
        gauge = region.eroded().gauges(length * direction)[-1]
        moved = (soft(point) - point).norm(dim=-1)
        # 1 - (1 + G^2)^(-1/2) <= G^2 / 2, for both of the two retractions.
        assert (moved <= length * 1.01 * gauge.square() + 1e-15).all()
        _, log_det = soft.forward_and_log_det(point)
        assert (log_det.abs() <= 4.1 * gauge.square()).all()


def test_the_sharpest_is_nearly_the_clip_along_rays() -> None:
    make = Maker(3, (8,), seed=6)
    region = Region((make.bounds(), make.ellipsoid()), make.anchor)
    point = make.anchor + torch.randn(100, 8, 3, dtype=torch.float64)
    clipped = region.eroded().pulled_in(point)
    for sharpness, close in ((4, 0.2), (100, 0.01)):
        soft = SoftRetraction(region, sharpness=sharpness, by_components=False)
        assert (soft(point) - clipped).abs().max() < close * make.size


def barrier(dtype: torch.dtype) -> tuple[HalfSpaces, Tensor]:
    """Two rows with an unbounded wedge between them, and an anchor 0.3 inside of both."""
    normals = torch.tensor([[1.0, 0.25], [-0.5, 1.0]], dtype=dtype)
    anchor = torch.tensor([-0.5, -1.0], dtype=dtype)
    offsets = (normals * anchor).sum(-1) + 0.3 * normals.norm(dim=-1)
    return HalfSpaces(normals, offsets), anchor


def test_from_an_unbounded_outer_set() -> None:
    """From a wedge onto its part in the bounds: bijective, its far sides left alone."""
    wedge, anchor = barrier(torch.float64)
    bounds = Box(-2 * torch.ones(2, dtype=torch.float64), torch.ones(2, dtype=torch.float64))
    region = Region((bounds, wedge), anchor)
    soft = SoftRetraction(region, outer=wedge.eroded(1e3), sharpness=2)
    points = anchor + 50 * torch.randn(4000, 2, dtype=torch.float64)
    points = points[wedge.eroded(1e3).contains(points)]
    assert len(points) > 500
    action, log_det = soft.forward_and_log_det(points)
    assert region.contains(action).all()
    assert (log_det - log_abs_det(soft, points)).abs().max() < 1e-9
    latent, _ = soft.inverse_and_log_det(action)
    torch.testing.assert_close(latent, points, rtol=1e-6, atol=1e-6)
    # Along the wedge's own boundary nothing is in the way but the bounds, and the map stays there.
    edge = anchor + 0.3 * torch.nn.functional.normalize(wedge.normals[0], dim=-1)
    assert (soft(edge * 0.999 + 0.001 * anchor) - edge).norm() < 0.05
    outside = soft.inverse_and_log_det(torch.tensor([1.5, 0.0], dtype=torch.float64))[0]
    assert outside.isnan().any()


@pytest.mark.parametrize("dtype", DTYPES)
def test_regions_without_finite_bounds(dtype: torch.dtype) -> None:
    wedge, anchor = barrier(dtype)
    infinite = torch.full((2,), torch.inf, dtype=dtype)
    region = Region((Box(-infinite, infinite), wedge), anchor)
    soft = SoftRetraction(region, sharpness=2)
    case = Case("", "soft-alone", (cast(wedge, torch.float64),), cast_anchor(anchor))
    number = np.float64 if dtype == torch.float32 else np.longdouble
    for length in LENGTHS:
        action, log_det = soft.forward_and_log_det(latents(case, 2000, dtype, length))
        assert action.isfinite().all()
        assert log_det.isfinite().all()
        if dtype == torch.float32 or LONGER:
            assert reference.contains(wedge, action, number).all()
    # Away from the rows, a thousand times the anchor's slack out, actions stay as they are.
    away = anchor + torch.tensor([-30.0, -60.0], dtype=dtype)
    assert (soft(away) - away).norm() < 0.1 * (away - anchor).norm()


def cast_anchor(anchor: Tensor) -> Tensor:
    return anchor.double()


def test_a_region_without_any_constraint() -> None:
    infinite = torch.full((2,), torch.inf)
    soft = SoftRetraction(Region((Box(-infinite, infinite),), torch.zeros(2)))
    z = torch.randn(50, 2) * 1e6
    torch.testing.assert_close(soft(z), z)


@pytest.mark.parametrize("sharpness", [0.5, 0.0, -1.0, 101.0, float("nan"), float("inf")])
def test_sharpness_out_of_range_is_refused(sharpness: float) -> None:
    region = Region(
        (Box(-torch.ones(2), torch.ones(2)), Ball(torch.zeros(2), torch.tensor(0.5))),
        torch.zeros(2),
    )
    for build in (SoftSquash, SoftRetraction):
        with pytest.raises(ValueError, match="sharpness: expected a number from 1 to 100, given"):
            build(region, sharpness=sharpness)
