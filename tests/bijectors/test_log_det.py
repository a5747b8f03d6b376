"""Log-determinants against autograd where it can be trusted, and against mpmath beyond."""

from __future__ import annotations

import pytest
import torch
from mpmath import mpf
from torch import Tensor

from tests.bijectors.cases import CASES, Case, latents_of
from tests.bijectors.numeric import log_abs_det

ids = {"ids": lambda case: case.name}
# The recession is compared with mpmath in test_recession.
WITHOUT_REFERENCE = ("visible", "recession")
WITH_REFERENCE = [case for case in CASES if not any(n in case.name for n in WITHOUT_REFERENCE)]


# Far beyond the rows the recession's slope vanishes beside 1, which autograd subtracts it from.
BY_AUTOGRAD = [case for case in CASES if case.kind != "recession"]


@pytest.mark.parametrize("case", BY_AUTOGRAD, **ids)
def test_log_det_is_that_of_the_jacobian(case: Case) -> None:
    bijector = case.build(torch.float64)
    lengths = (0.05, 0.5, 2.0, 5.0, 8.0)
    z = latents_of(case, 4, torch.float64, lengths)
    action, log_det = bijector.forward_and_log_det(z)
    expected = log_abs_det(bijector, z)
    # Autograd computes 1 - tanh(z)^2 by subtraction: at 8 it has lost 7 of its 16 digits.
    assert (log_det - expected).abs().max() < 1e-9 + case.cancellation
    torch.testing.assert_close(bijector.log_abs_det_jacobian(z, action), log_det, rtol=0, atol=0)


@pytest.mark.parametrize("case", WITH_REFERENCE, **ids)
def test_forward_and_log_det_match_mpmath(case: Case) -> None:
    bijector = case.build(torch.float64)
    z = latents_of(case, 1, torch.float64, (1e-12, 1.0, 20.0, 1e6))
    action, log_det = bijector.forward_and_log_det(z)
    # The seam left by erosion, 16 eps wide, counts more the nearer the anchor lies to a boundary.
    close, wide = 1e-9 + 1e-13 * case.dim * case.tightness, seam(case)
    # The first and the last element of a batch in turn: `test_shapes` holds them to be alike.
    first, last = (0,) * len(case.batch_shape), tuple(size - 1 for size in case.batch_shape)
    for row, index in enumerate((first, last) * 2):
        expected_action, expected = case.reference(index)(exact(z[row][index]))
        found = action[row][index].tolist()
        error = max(abs(mpf(a) - b) for a, b in zip(found, expected_action, strict=True))
        assert error <= 1e-12 * case.size + wide
        found_log_det = mpf(log_det[row][index].item())
        assert abs(found_log_det - expected) <= close * (1 + abs(expected) * 1e-6)


def seam(case: Case) -> float:
    """Return how far erosion moves the boundary, by the rounding of sets larger than bounds."""
    if case.anchor is None:
        return 0.0
    region = case.region(torch.float64)
    return float((region.slack(region.anchor) - region.eroded().slack(region.anchor)).max())


def exact(value: Tensor) -> list[mpf]:
    return [mpf(value) for value in value.tolist()]
