"""The recession: half-spaces kept exactly at any size, its way out, and states without one."""

from __future__ import annotations

import contextlib
import itertools

import numpy as np
import pytest
import torch
from mpmath import mp, mpf
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.bijectors import Recession, SoftRetraction
from cnfp_torchrl.bijectors.recession import LEAST_MARGIN, hull_point
from cnfp_torchrl.geometry import Ball, Box, GeometryError, HalfSpaces, Region
from tests.bijectors import reference
from tests.bijectors.cases import CASES, DTYPES, Case
from tests.bijectors.numeric import log_abs_det
from tests.bijectors.rounding import RoundedOtherwise
from tests.bijectors.test_inside import LONGER

SHAPES = [(1, 1), (1, 2), (2, 2), (3, 3), (5, 6)]
LENGTHS = (0.0, 1e-6, 1.0, 10.0, 1e3, 1e6, 1e10, 1e15)


def everywhere(dim: int, dtype: torch.dtype) -> Box:
    infinite = torch.full((dim,), torch.inf, dtype=dtype)
    return Box(-infinite, infinite)


def barriers(rows: int, dim: int, dtype: torch.dtype, count: int = 200) -> HalfSpaces:
    """Rows that all leave a common way out, around -1 in all components."""
    random = torch.Generator().manual_seed(rows + dim)
    normals = 0.6 * torch.randn(count, rows, dim, generator=random) + 1
    lead = normals.sum(-1, keepdim=True)
    normals = normals + (0.3 - lead).clamp(min=0)  # none leads back by more than it should
    return HalfSpaces(normals.to(dtype), torch.randn(count, rows, generator=random).to(dtype))


@pytest.mark.parametrize(("rows", "dim"), SHAPES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("scale", [1e-3, 1.0])
def test_rows_hold_for_wished_actions_of_any_size(
    rows: int, dim: int, dtype: torch.dtype, scale: float
) -> None:
    if dtype == torch.float64 and not LONGER:
        pytest.skip("NumPy has no number longer than float64 here")
    sets = barriers(rows, dim, dtype)
    recession = Recession(Region((everywhere(dim, dtype), sets)), scale=scale)
    number = np.float64 if dtype == torch.float32 else np.longdouble
    for length in LENGTHS:
        wished = length * torch.randn(50, 200, dim, dtype=dtype)
        action, log_det = recession.forward_and_log_det(wished)
        assert action.isfinite().all()
        assert log_det.isfinite().all()
        assert reference.contains(sets, action, number).all(), f"at {length}"


@pytest.mark.parametrize("length", [1e-12, 1.0, 20.0, 1e6])
def test_actions_and_densities_match_mpmath(length: float) -> None:
    random, scale = torch.Generator().manual_seed(3), 0.5
    sets = barriers(3, 2, torch.float64)
    way = torch.tensor([-2.0, -1.5], dtype=torch.float64)
    recession = Recession(
        Region((everywhere(2, torch.float64), sets)), way, scale=scale, validate_args=False
    )
    wished = torch.randn(200, 2, generator=random, dtype=torch.float64)
    wished = length * wished / vector_norm(wished, dim=-1, keepdim=True)
    action, log_det = recession.forward_and_log_det(wished)
    r = [mpf(-4) / 5, mpf(-3) / 5]
    for i in range(20):
        f = [mpf(x) for x in wished[i].tolist()]
        rows = zip(sets.normals[i].tolist(), sets.offsets[i].tolist(), strict=True)
        if any(float(reference.dot(map(mpf, n), r)) > -0.05 for n, _ in list(rows)):
            continue
        rows = zip(sets.normals[i].tolist(), sets.offsets[i].tolist(), strict=True)
        need = max(
            (reference.dot(map(mpf, n), f) - mpf(b)) / -reference.dot(map(mpf, n), r)
            for n, b in rows
        )
        moved = mp.log(1 + mp.exp(need / scale))
        # The rows are eroded by 16 rounding errors, over a rate of 0.05 or more.
        close = 5e-13 * (1 + length)
        for a, x, way_out in zip(action[i].tolist(), f, r, strict=True):
            assert abs(mpf(a) - (x + way_out * scale * moved)) < close
        assert abs(mpf(log_det[i].item()) + moved) < close / scale


@pytest.mark.parametrize(("rows", "dim"), SHAPES)
def test_log_det_and_inverse(rows: int, dim: int) -> None:
    sets = barriers(rows, dim, torch.float64)
    recession = Recession(Region((everywhere(dim, torch.float64), sets)))
    wished = torch.randn(20, 200, dim, dtype=torch.float64)
    action, log_det = recession.forward_and_log_det(wished)
    # Autograd subtracts from 1 what leaves exp(log_det) over.
    clear = log_det > -8
    assert clear.double().mean() > 0.5
    assert (log_det - log_abs_det(recession, wished)).abs()[clear].max() < 1e-9
    latent, inverse_log_det = recession.inverse_and_log_det(action)
    assert (latent - wished).abs().amax(-1)[clear].max() < 1e-9
    assert (inverse_log_det + log_det).abs()[clear].max() < 1e-9
    # Each action that keeps its distance has a latent, none beyond a row has.
    point = 3 * torch.randn(20, 200, dim, dtype=torch.float64)
    slack = sets.slack(point)
    inside, outside = recession.contains(point)[slack > 1e-9], recession.contains(point)[slack < 0]
    assert inside.all() and not outside.any()  # noqa: PT018
    assert len(inside) > 100
    again = recession(recession.inverse_and_log_det(point)[0])
    assert (again - point).abs()[slack > 1e-9].max() < 1e-12


def test_safe_actions_stay() -> None:
    sets = barriers(3, 2, torch.float64)
    recession = Recession(Region((everywhere(2, torch.float64), sets)), scale=0.1)
    wished = -3 * torch.rand(50, 200, 2, dtype=torch.float64)
    slack = sets.slack(wished)
    moved = vector_norm(recession(wished) - wished, dim=-1)
    # The way to a row's boundary is at least as long as the slack.
    assert (moved <= 0.1 * torch.exp(-slack / 0.1) + 1e-13).all()
    assert moved[slack > 4].max() < 1e-13


@pytest.mark.parametrize(("rows", "dim"), [(2, 2), (3, 2), (3, 3), (5, 3), (6, 6), (7, 4)])
def test_the_way_out_has_the_largest_margin(rows: int, dim: int) -> None:
    normals = barriers(rows, dim, torch.float64, 50).normals
    normals = normals / vector_norm(normals, dim=-1, keepdim=True)
    way = torch.nn.functional.normalize(
        -hull_point(normals, torch.ones(50, rows, dtype=torch.bool)), dim=-1
    )
    margin = -(normals * way.unsqueeze(-2)).sum(-1).amax(-1)
    best = [largest_margin(normal.numpy()) for normal in normals]
    torch.testing.assert_close(
        margin, torch.tensor(best, dtype=torch.float64), rtol=1e-7, atol=1e-9
    )


def largest_margin(normals: np.ndarray) -> float:
    """Return the least length in the hull of the normals, over all subsets of them."""
    least = np.inf
    for size in range(1, len(normals) + 1):
        for chosen in itertools.combinations(normals, size):
            gram = np.array(chosen) @ np.array(chosen).T
            if np.linalg.cond(gram) > 1e10:
                continue
            weights = np.linalg.solve(gram, np.ones(size))
            if (weights >= 0).all():
                least = min(least, np.linalg.norm(weights @ np.array(chosen)) / weights.sum())
    return least


@pytest.mark.parametrize("rows", [1, 2, 3])
def test_gradients_reach_the_rows(rows: int) -> None:
    given = barriers(rows, 3, torch.float64, 4)
    normals, offsets = given.normals.requires_grad_(), given.offsets.requires_grad_()
    wished = torch.randn(4, 3, dtype=torch.float64, requires_grad=True)

    def act(wished: Tensor, normals: Tensor, offsets: Tensor) -> Tensor:
        sets = HalfSpaces(normals, offsets, validate_args=False)
        region = Region((everywhere(3, torch.float64), sets))
        return Recession(region, validate_args=False)(wished)

    assert torch.autograd.gradcheck(act, (wished, normals, offsets), atol=1e-6)


def test_equal_rows_and_rows_that_do_not_count() -> None:
    normals = torch.tensor([[1.0, 0.0], [1.0, 0.0], [2.0, 0.0], [0.0, 0.0], [0.0, 1.0]])
    offsets = torch.tensor([1.0, 1.0, 2.0, 0.0, torch.inf])
    recession = Recession(Region((everywhere(2, torch.float32), HalfSpaces(normals, offsets))))
    action = recession(torch.tensor([[5.0, 7.0], [-50.0, 7.0]]))
    assert (action[:, 0] < 1).all()
    torch.testing.assert_close(action[:, 1], torch.tensor([7.0, 7.0]))
    torch.testing.assert_close(action[1, 0], torch.tensor(-50.0))


def bounded(dtype: torch.dtype) -> Region:
    """Two states of bounds, a ball and rows, which have no way out in common in the second."""
    ones = torch.ones(2, dtype=dtype)
    normals = torch.tensor(
        [[[1.0, 0.2], [0.2, 1.0], [0.7, 0.7]], [[1.0, 0], [-1, 0.3], [-1, -0.3]]]
    )
    rows = HalfSpaces(normals.to(dtype), torch.full((2, 3), 0.25, dtype=dtype))
    ball = Ball(0.1 * ones, torch.tensor(0.9, dtype=dtype))
    return Region((Box(-ones, ones), rows, ball), torch.zeros(2, 2, dtype=dtype))


def test_without_a_way_out_in_common() -> None:
    region = bounded(torch.float64)
    alone = Region((everywhere(2, torch.float64), region.sets[1]))
    with pytest.raises(GeometryError, match=r"no row closer than 0.01 .* at index \[1\].*anchor"):
        Recession(alone)
    wished = torch.randn(100, 2, 2, dtype=torch.float64)
    unchecked = Recession(alone, validate_args=False)(wished)
    assert unchecked[:, 0].isfinite().all()
    assert unchecked[:, 1].isnan().all()
    # With an anchor it is softly retracted there, as if there were no recession.
    recession = Recession(region, of_latents=False)
    soft = SoftRetraction(region, by_components=False)
    torch.testing.assert_close(recession(wished)[:, 1], soft(wished)[:, 1])
    assert not torch.allclose(recession(wished)[:, 0], soft(wished)[:, 0])
    assert LEAST_MARGIN == 0.01


@pytest.mark.parametrize("dtype", DTYPES)
def test_recession_into_bounds(dtype: torch.dtype) -> None:
    region = bounded(dtype)
    recession, exact = Recession(region), bounded(torch.float64)
    for length in LENGTHS:
        action, log_det = recession.forward_and_log_det(length * torch.randn(500, 2, 2).to(dtype))
        assert exact.contains(action.double()).all()
        assert log_det.isfinite().all()


def test_recession_into_bounds_is_a_bijection() -> None:
    region = bounded(torch.float64)
    for of_latents in (False, True):
        recession = Recession(region, of_latents=of_latents)
        wished = 0.7 * torch.randn(300, 2, 2, dtype=torch.float64)
        action, log_det = recession.forward_and_log_det(wished)
        assert (log_det - log_abs_det(recession, wished)).abs().max() < 1e-9
        latent, inverse_log_det = recession.inverse_and_log_det(action)
        torch.testing.assert_close(latent, wished, rtol=1e-8, atol=1e-8)
        torch.testing.assert_close(inverse_log_det, -log_det, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("case", [c for c in CASES if c.kind == "recession"], ids=lambda c: c.name)
@pytest.mark.parametrize("otherwise", [False, True])
def test_actions_before_the_boundary_have_a_latent(case: Case, otherwise: bool) -> None:
    r"""Inverse and forward give an action back up to some rounding errors, times the condition.

    The row that decides turns an error e of the wished action into e - r sigma (A_k e) / rate, at
    most 1 + 1/rate times as large. An error of the need moves the action by no more than itself.
    The inverse makes an error of what is left before the row up to s / left times larger, along r,
    where forward's slope is smaller than left / s. So each of the some 8 + d roundings of numbers
    as large as the wished action arrives at most 1 + 1/rate times larger.
    """
    bijector = case.build(torch.float64)
    assert isinstance(bijector, Recession)
    bounds = case.sets[0].bounding_box()
    condition = 1 + 1 / least_rate(case)
    # Results one unit further off have three times the error of correctly rounded ones.
    roundings = (8 + case.dim) * (3 if otherwise else 1)
    for progress in (1e-6, 0.1, 0.9, 1 - 1e-3):
        direction = torch.randn(200, *case.batch_shape, case.dim, dtype=torch.float64)
        gauge = bijector.region.gauges(direction)[-1].unsqueeze(-1)
        action = bijector.region.anchor + direction / gauge * progress
        assert bijector.contains(action).all()
        with RoundedOtherwise() if otherwise else contextlib.nullcontext():
            latent = bijector.inverse_and_log_det(action)[0]
            error = (bijector(latent) - action).abs().amax(-1)
        wished = (bounds.low + bounds.high) / 2 + latent * (bounds.high - bounds.low) / 2
        size = wished.abs().amax(-1).clamp(min=case.size)
        assert (error <= roundings * condition * torch.finfo(torch.float64).eps * size).all()


def least_rate(case: Case) -> Tensor:
    """Return the least sine of the angle between the way out and a row, ``(*batch,)``."""
    rows = [s for s in case.sets if isinstance(s, HalfSpaces)]
    if not rows:
        return torch.tensor(1.0)
    assert len(rows) == 1
    unit = rows[0].normals / vector_norm(rows[0].normals, dim=-1, keepdim=True)
    found = [largest_margin(normals.numpy()) for normals in unit.reshape(-1, *unit.shape[-2:])]
    margin = torch.tensor(found).reshape(unit.shape[:-2])
    return torch.where(margin > LEAST_MARGIN, margin, 1.0)


def test_what_does_not_fit_is_refused() -> None:
    region = bounded(torch.float64)
    with pytest.raises(GeometryError, match=r"half-spaces alone .* given \['Ball'\]"):
        Recession(Region(region.sets))
    with pytest.raises(GeometryError, match="expected infinite ones in a region without an anchor"):
        Recession(Region(region.sets[:2]))
    for scale in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="scale: expected a number > 0, given"):
            Recession(region, scale=scale)
