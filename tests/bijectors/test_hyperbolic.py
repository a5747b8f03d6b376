"""The hyperbolic functions and their slopes against mpmath, across the seams of their forms."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from mpmath import mp, mpf
from torch import Tensor

from cnfp_torchrl.bijectors.squashes import atanhc, log_sech_squared, radial_log_det, tanhc

Real = Callable[[mpf], mpf]


def check(
    function: Callable[[Tensor], Tensor], exact: Real, points: list[float], terms: int = 1
) -> None:
    """Compare values and slopes, to five units of rounding error for each term of size one."""
    x = torch.tensor(points, dtype=torch.float64, requires_grad=True)
    value = function(x)
    (slope,) = torch.autograd.grad(value.sum(), x)
    single = function(x.detach().float())
    for i, point in enumerate(x.tolist()):
        expected = exact(mpf(point))
        size = float(terms + abs(expected))
        assert abs(value[i].item() - expected) < 1e-15 * size, point
        assert abs(single[i].item() - exact(mpf(x[i].float().item()))) < 1e-6 * size, point
        expected_slope = mp.diff(exact, mpf(point), h=mpf(10) ** -10)
        assert abs(slope[i].item() - expected_slope) < 2e-13 * float(terms + abs(expected_slope)), (
            point
        )


# Beyond 10, torch's softplus of a positive argument leaves out e^-20, 2e-9.
NEAR = [1e-8, 1e-3, 0.05, 0.09999, 0.10001, 0.2, 0.5, 1.0, 3.0]
LENGTHS = [*NEAR, 9.9, 10.01, 10.5, 15.0, 20.0, 40.0]


def test_log_sech_squared() -> None:
    points = [0.0, *LENGTHS, *(-length for length in LENGTHS), 1e3, -1e3]
    check(log_sech_squared, lambda x: -2 * mp.log(mp.cosh(x)), points)


def test_log_sech_squared_of_huge_numbers() -> None:
    x = torch.tensor([1e15, -1e15, 1e30, -1e30])
    torch.testing.assert_close(log_sech_squared(x), -2 * x.abs())


@pytest.mark.parametrize("dim", [1, 2, 3, 32])
def test_radial_log_det(dim: int) -> None:
    def exact(q: mpf) -> mpf:
        rho = mp.sqrt(q)
        return -2 * mp.log(mp.cosh(rho)) + (dim - 1) * mp.log(mp.tanh(rho) / rho)

    check(lambda q: radial_log_det(q, dim), exact, [length**2 for length in LENGTHS], dim)
    assert radial_log_det(torch.zeros(1), dim).item() == 0


def test_tanhc() -> None:
    check(tanhc, lambda q: mp.tanh(mp.sqrt(q)) / mp.sqrt(q), [length**2 for length in LENGTHS])
    assert tanhc(torch.zeros(1)).item() == 1


def test_atanhc() -> None:
    points = [length**2 for length in LENGTHS if length < 0.9]
    check(atanhc, lambda q: mp.atanh(mp.sqrt(q)) / mp.sqrt(q), points)
    assert atanhc(torch.zeros(1)).item() == 1
