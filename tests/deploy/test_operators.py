"""Operators that ONNX lacks, in terms of others, give what PyTorch's own give."""

import pytest
import torch

from cnfp_torchrl.deploy.operators import OperatorsOfOnnx


def test_frexp_is_exact_over_the_range() -> None:
    torch.manual_seed(0)
    for dtype, least, most in ((torch.float32, -126, 128), (torch.float64, -1022, 1024)):
        powers = torch.pow(torch.tensor(2.0, dtype=dtype), torch.arange(least, most))
        random = powers * (1 + torch.rand_like(powers))
        beside = torch.nextafter(powers, torch.zeros_like(powers))[1:]
        odd = torch.tensor([0.0, -0.0, -3.0, torch.inf, -torch.inf], dtype=dtype)
        value = torch.cat([powers, random[:-1], beside, -beside, odd])
        expected = torch.frexp(value)
        with OperatorsOfOnnx():
            found = torch.frexp(value)
        assert torch.equal(found[0], expected[0])
        finite = value.isfinite()
        assert torch.equal(found[1][finite], expected[1][finite])


def test_fmin_takes_the_number() -> None:
    first, second = torch.tensor(
        [[1, 2, torch.nan, torch.nan, -torch.inf], [3, 1, 4, torch.nan, 0]]
    )
    with OperatorsOfOnnx():
        found = torch.fmin(first, second)
    assert torch.equal(found.nan_to_num(9), torch.fmin(first, second).nan_to_num(9))


def test_hypot_neither_overflows_nor_underflows() -> None:
    torch.manual_seed(0)
    sizes = 10.0 ** torch.arange(-30, 31)
    first, second = torch.randn(2, 61) * sizes
    first, second = (torch.cat([part, torch.tensor([0.0, torch.inf])]) for part in (first, second))
    with OperatorsOfOnnx():
        found = torch.hypot(first, second)
    torch.testing.assert_close(found, torch.hypot(first, second), rtol=1e-6, atol=0)


def test_where_among_flags_and_among_numbers() -> None:
    condition, chosen, other = torch.tensor([[1, 0, 1, 0], [1, 1, 0, 0], [0, 1, 1, 0]]).bool()
    expected = torch.where(condition, chosen, other)
    with OperatorsOfOnnx():
        assert torch.equal(torch.where(condition, chosen, other), expected)
        assert torch.where(condition, 1.0, torch.inf).tolist() == [1, torch.inf, 1, torch.inf]


@pytest.mark.parametrize("dim", [1, 2, 6, 32])
def test_solvers(dim: int) -> None:
    torch.manual_seed(0)
    lower = torch.randn(5, dim, dim).double().tril(-1) / dim + torch.eye(dim).double()
    right = torch.randn(5, dim, 3).double()
    matrix = lower @ lower.mT
    with OperatorsOfOnnx():
        triangular = torch.linalg.solve_triangular(lower, right, upper=False)
        shared = torch.linalg.solve_triangular(lower, torch.eye(dim).double(), upper=False)
        whole, info = torch.linalg.solve_ex(matrix, right)
        other = torch.linalg.solve_triangular(lower.mT, right, upper=True)
    torch.testing.assert_close(lower @ triangular, right)
    torch.testing.assert_close(lower @ shared, torch.eye(dim).double().expand(5, -1, -1))
    torch.testing.assert_close(matrix @ whole, right)
    torch.testing.assert_close(lower.mT @ other, right)
    assert info.tolist() == [0] * 5
