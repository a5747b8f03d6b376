"""Batches, samples and dtypes: every element by itself, broadcast as PyTorch does."""

from __future__ import annotations

import copy
import pickle
from typing import TypedDict

import pytest
import torch
from torch.distributions import AffineTransform, ComposeTransform

from tests.bijectors.cases import CASES, DTYPES, Case, element, latents


class Tolerance(TypedDict):
    rtol: float
    atol: float


ids = {"ids": lambda case: case.name}
# Of one computation over batches of other shapes or strides, whose kernels may round differently.
OF_ACTIONS: Tolerance = {"rtol": 1e-12, "atol": 1e-14}
OF_LOG_DETS: Tolerance = {"rtol": 1e-10, "atol": 1e-11}
BATCHED = [case for case in CASES if case.batch_shape]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("case", CASES, **ids)
def test_shapes_and_dtypes(case: Case, dtype: torch.dtype) -> None:
    bijector = case.build(dtype)
    assert bijector.shape == (*case.batch_shape, case.dim)
    z = torch.randn(5, 2, *bijector.shape, dtype=dtype)
    action, log_det = bijector.forward_and_log_det(z)
    assert action.shape == z.shape
    assert log_det.shape == z.shape[:-1]
    latent, inverse_log_det = bijector.inverse_and_log_det(action)
    assert latent.shape == z.shape
    assert inverse_log_det.shape == z.shape[:-1]
    assert bijector.contains(action).shape == z.shape[:-1]
    for value in (action, log_det, latent, inverse_log_det):
        assert value.dtype == dtype
    torch.testing.assert_close(bijector(z), action, rtol=0, atol=0)
    torch.testing.assert_close(bijector.inv(action), latent, rtol=0, atol=0, equal_nan=True)
    _, reference_log_det = bijector.forward_and_reference_log_det(z)
    assert reference_log_det.shape == log_det.shape


@pytest.mark.parametrize("case", BATCHED, **ids)
def test_each_batch_element_is_computed_by_itself(case: Case) -> None:
    bijector = case.build(torch.float64)
    z = latents(case, 3, torch.float64)
    action, log_det = bijector.forward_and_log_det(z)
    for index in torch.cartesian_prod(*map(torch.arange, case.batch_shape)).reshape(
        -1, len(case.batch_shape)
    ):
        at = tuple(index.tolist())
        alone = single(case, at).build(torch.float64)
        own = z[(slice(None), *at)]
        expected, expected_log_det = alone.forward_and_log_det(own)
        torch.testing.assert_close(action[(slice(None), *at)], expected, **OF_ACTIONS)
        torch.testing.assert_close(log_det[(slice(None), *at)], expected_log_det, **OF_LOG_DETS)
        assert torch.equal(bijector.contains(action)[(slice(None), *at)], alone.contains(expected))


def single(case: Case, at: tuple[int, ...]) -> Case:
    """Return the case of one batch element."""
    sets = tuple(element(constraint_set, case.batch_shape, at) for constraint_set in case.sets)
    anchor, active = case.anchor, case.active
    if anchor is not None:
        anchor = anchor.expand((*case.batch_shape, case.dim))[at]
    if active is not None:
        active = active.expand((*case.batch_shape, len(sets)))[at]
    return Case(case.name, case.kind, sets, anchor, active)


@pytest.mark.parametrize("case", BATCHED, **ids)
def test_one_latent_serves_a_batch_of_sets(case: Case) -> None:
    bijector = case.build(torch.float64)
    z = torch.randn(case.dim, dtype=torch.float64)
    expected, expected_log_det = bijector.forward_and_log_det(z.expand(bijector.shape))
    action, log_det = bijector.forward_and_log_det(z)
    torch.testing.assert_close(action, expected, **OF_ACTIONS)
    torch.testing.assert_close(log_det, expected_log_det, **OF_LOG_DETS)
    stages, whole = bijector.stages(z), bijector.stages(z.expand(bijector.shape))
    torch.testing.assert_close(stages.actions, whole.actions, **OF_ACTIONS)
    torch.testing.assert_close(stages.log_dets, whole.log_dets, **OF_LOG_DETS)


@pytest.mark.parametrize("case", CASES, **ids)
def test_nan_stays_nan(case: Case) -> None:
    bijector = case.build(torch.float32)
    z = torch.randn(*bijector.shape)
    z[..., -1] = torch.nan
    action, log_det = bijector.forward_and_log_det(z)
    assert action[..., -1].isnan().all()
    assert log_det.isnan().all()
    latent, inverse_log_det = bijector.inverse_and_log_det(action)
    assert latent[..., -1].isnan().all()
    assert inverse_log_det.isnan().all()


@pytest.mark.parametrize("name", ["gauge-dropped-d3-batch", "ball-d2", "box-ball-d2"])
def test_bijectors_are_transforms(name: str) -> None:
    """They compose with PyTorch's own, travel between processes and can be copied."""
    case = next(case for case in CASES if case.name == name)
    bijector = case.build(torch.float64)
    z = latents(case, 3, torch.float64)
    action, log_det = bijector.forward_and_log_det(z)
    composed = ComposeTransform([bijector, AffineTransform(0.0, 2.0, event_dim=1)])
    torch.testing.assert_close(composed(z), 2 * action)
    torch.testing.assert_close(
        composed.log_abs_det_jacobian(z, composed(z)),
        log_det + case.dim * torch.tensor(2.0).double().log(),
    )
    for copied in (copy.deepcopy(bijector), pickle.loads(pickle.dumps(bijector))):
        torch.testing.assert_close(copied(z), action, rtol=0, atol=0)
