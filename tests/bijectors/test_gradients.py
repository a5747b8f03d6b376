"""Gradients: finite everywhere, right where they exist, bounded where the density is smooth."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cnfp_torchrl.bijectors import Bijector, GaugeSquash
from cnfp_torchrl.geometry import Ball, Box, Region
from tests.bijectors.cases import CASES, DTYPES, Case, cast, latents, latents_of, tensor
from tests.bijectors.numeric import central_difference

ids = {"ids": lambda case: case.name}


def gradients(bijector: Bijector, latent: Tensor) -> tuple[Tensor, Tensor]:
    """Return the latent's gradients of the sum of the actions and of the log-determinant."""
    latent = latent.detach().requires_grad_()
    action, log_det = bijector.forward_and_log_det(latent)
    (of_action,) = torch.autograd.grad(action.sum(), latent, retain_graph=True)
    (of_log_det,) = torch.autograd.grad(log_det.sum(), latent)
    return of_action, of_log_det


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("case", CASES, **ids)
def test_gradients_are_finite(case: Case, dtype: torch.dtype) -> None:
    lengths = (0.0, 1e-40, 1e-25, 1e-18, 1e-12, 1.0, 8.0, 20.0, 1e6, 1e15)
    z = latents_of(case, 20, dtype, lengths)
    for gradient in gradients(case.build(dtype), z):
        assert z[~gradient.isfinite()].tolist() == []


@pytest.mark.parametrize("case", CASES, **ids)
def test_gradients_equal_finite_differences(case: Case) -> None:
    bijector = case.build(torch.float64)
    z = latents_of(case, 8, torch.float64, (0.3, 1.0, 3.0))
    # A step across a kink tells nothing; on the axes and diagonals of `latents` there are some.
    z = z + 0.01 * torch.randn_like(z)
    direction = torch.randn_like(z)
    direction = direction / direction.norm(dim=-1, keepdim=True)
    for which, scale in ((0, case.size), (1, float(case.dim))):
        weights = torch.randn(case.dim, dtype=torch.float64)

        def function(point: Tensor, which: int = which, weights: Tensor = weights) -> Tensor:
            value = bijector.forward_and_log_det(point)[which]
            return (value * weights).sum(-1) if which == 0 else value

        point = z.detach().requires_grad_()
        (gradient,) = torch.autograd.grad(function(point).sum(), point)
        slope = (gradient * direction).sum(-1)
        step = 2e-5 if case.saturates else 1e-4
        coarse, fine = (central_difference(function, z, direction, h) for h in (step, step / 2))
        # Where the two agree there is no kink in the way.
        smooth = (coarse - fine).abs() <= 1e-8 * scale * case.tightness
        assert smooth.double().mean() > 0.9
        assert ((slope - fine).abs() <= 1e-7 * (scale * case.tightness + slope.abs()))[smooth].all()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("case", [case for case in CASES if case.smooth], **ids)
def test_log_det_gradients_are_bounded(case: Case, dtype: torch.dtype) -> None:
    """|d L/d rho| <= 2 and |d log(tanh(rho)/rho)/d rho| <= 1, elementwise or radially."""
    bijector = case.build(dtype)
    for length in (0.0, 1e-40, 1e-12, 1e-6, 0.1, 1.0, 20.0, 1e6):
        _, gradient = gradients(bijector, latents(case, 50, dtype, length))
        bound = 2.0 if "box" in case.name or "bounds" in case.name else 1.0 + case.dim
        assert gradient.abs().max() <= bound * 1.001, f"at |z| = {length}"


@pytest.mark.parametrize("dtype", DTYPES)
def test_gradients_near_the_anchor_are_bounded_where_nothing_binds(dtype: torch.dtype) -> None:
    bounds = Box(tensor(-1.0, -0.5, -3.0), tensor(1.0, 2.0, 1.5))
    loose = Ball(tensor(0.3, -0.2, 0.0), tensor(10.0).squeeze())
    sets = cast(bounds, dtype), cast(loose, dtype)
    bijector = GaugeSquash(Region(sets, tensor(0.1, 0.3, -0.4).to(dtype)))
    anchor = bijector.inverse_and_log_det(bijector.region.anchor)[0]
    for length in (0.0, 1e-12, 1e-8, 1e-6, 1e-4, 1e-2):
        z = anchor + length * torch.randn(200, 3, dtype=dtype)
        of_action, of_log_det = gradients(bijector, z)
        assert of_log_det.abs().max() <= 2.0
        assert of_action.abs().max() <= 2.25 * 1.001


@pytest.mark.parametrize("dtype", DTYPES)
def test_gradients_in_one_dimension_are_bounded(dtype: torch.dtype) -> None:
    """There are two directions only, in each of which the share is constant."""
    sets = Box(tensor(-1.0), tensor(1.0)), Ball(tensor(0.2), tensor(0.3).squeeze())
    bijector = GaugeSquash(
        Region(
            tuple(cast(constraint_set, dtype) for constraint_set in sets), torch.zeros(1).to(dtype)
        )
    )
    for length in (0.0, 1e-40, 1e-20, 1e-12, 1e-3, 1.0, 20.0, 1e6):
        _, of_log_det = gradients(bijector, length * torch.tensor([[1.0], [-1.0]]).to(dtype))
        assert of_log_det.abs().max() <= 2.0


def test_log_det_gradient_grows_like_one_over_the_distance_to_the_anchor() -> None:
    """As documented: the direction's share of the log-density, seen from ever nearer."""
    sets = Box(tensor(-1.0, -1.0), tensor(1.0, 1.0)), Ball(tensor(0.2, 0.0), tensor(0.5).squeeze())
    bijector = GaugeSquash(Region(sets, tensor(0.0, 0.0)))
    z = torch.randn(200, 2, dtype=torch.float64)
    z = z / z.norm(dim=-1, keepdim=True)
    grown = [
        (gradients(bijector, distance * z)[1] * distance).abs().amax().item()
        for distance in (1e-2, 1e-5, 1e-8, 1e-11)
    ]
    assert all(abs(value / grown[-1] - 1) < 0.01 for value in grown)
    assert 1 < grown[-1] < 10


def test_radial_squash_has_a_gradient_at_zero() -> None:
    """A policy whose last layer starts at zero sends z = 0, and without a gradient stays there."""
    sets = Box(tensor(-1.0, -1.0), tensor(1.0, 1.0)), Ball(tensor(0.2, 0.0), tensor(0.5).squeeze())
    for kind in ("exact", "gauge", "radial"):
        bijector = Case("", kind, sets, tensor(0.0, 0.0)).build(torch.float32)
        of_action, _ = gradients(bijector, torch.zeros(2))
        assert (of_action > 0.1).all()
