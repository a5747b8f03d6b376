"""Operators that ONNX lacks, in terms of those that it has.

They replace operators while a program is exported, whoever wrote them: families of sets and
geometries of one's own may use them, too, and in eager mode nobody pays for them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode


class OperatorsOfOnnx(TorchFunctionMode):
    """Replace operators that ONNX lacks, in its context."""

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Sequence[type],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        """Return what a replacement returns, or else the operator itself."""
        replacement = _REPLACEMENTS.get(func)
        if replacement is not None:
            result = replacement(*args, **(kwargs or {}))
            if result is not NotImplemented:
                return result
        return func(*args, **(kwargs or {}))


def _where(condition: Tensor, chosen: Any, other: Any) -> Any:
    """Choose among flags; onnxruntime chooses among numbers alone."""
    if not all(
        isinstance(value, Tensor) and value.dtype == torch.bool for value in (chosen, other)
    ):
        return NotImplemented
    return (condition & chosen) | (~condition & other)


def _fmin(first: Tensor, second: Tensor) -> Tensor:
    return torch.where(first.isnan() | (second < first), second, first)


def _hypot(first: Tensor, second: Tensor) -> Tensor:
    """Return lengths whose squares may be out of range."""
    size = torch.maximum(first.abs(), second.abs())
    unit = torch.where((size > 0) & size.isfinite(), size, 1.0)
    length = unit * ((first / unit).square() + (second / unit).square()).sqrt()
    return torch.where(size.isfinite(), length, size)


def _frexp(value: Tensor) -> tuple[Tensor, Tensor]:
    """Split numbers into mantissas in [0.5, 1) and powers of two, exactly."""
    size = value.abs()
    usual = (size > 0) & size.isfinite()
    size = torch.where(usual, size, 1.0)
    exponent = size.log2().floor() + 1
    # Not by one power, which may be out of range; and the logarithm may be a rounding error off.
    half = (exponent / 2).floor()
    mantissa = size * torch.pow(2.0, -half) * torch.pow(2.0, half - exponent)
    above, below = mantissa >= 1, mantissa < 0.5
    step = above.to(value.dtype) - below.to(value.dtype)
    mantissa = torch.where(above, mantissa / 2, torch.where(below, mantissa * 2, mantissa))
    mantissa = torch.where(usual, torch.where(value < 0, -mantissa, mantissa), value)
    return mantissa, torch.where(usual, exponent + step, 0.0).to(torch.int32)


def _solve_triangular(
    matrix: Tensor,
    right: Tensor,
    *,
    upper: bool,
    left: bool = True,
    unitriangular: bool = False,
) -> Any:
    """Solve by substitution, one row after the other."""
    if upper or not left or unitriangular:
        return NotImplemented
    rows: list[Tensor] = []
    for i in range(matrix.shape[-1]):
        rest = right[..., i, :]
        if rows:
            known = torch.stack(torch.broadcast_tensors(*rows), -2)
            rest = rest - (matrix[..., i, :i].unsqueeze(-1) * known).sum(-2)
        rows.append(rest / matrix[..., i, i].unsqueeze(-1))
    return torch.stack(torch.broadcast_tensors(*rows), -2)


def _solve_ex(
    matrix: Tensor, right: Tensor, *, left: bool = True, check_errors: bool = False
) -> Any:
    """Solve by elimination without exchange of rows, as positive definite matrices allow."""
    if not left:
        return NotImplemented
    rest = torch.cat([matrix, right], -1)
    rows = []
    for _ in range(matrix.shape[-1]):
        rows.append(rest[..., 0, 1:] / rest[..., :1, 0])
        rest = rest[..., 1:, 1:] - rest[..., 1:, :1] * rows[-1].unsqueeze(-2)
    columns = right.shape[-1]
    solution: list[Tensor] = []
    for row in reversed(rows):
        value = row[..., -columns:]
        if solution:
            known = torch.stack(solution, -2)
            value = value - (row[..., :-columns].unsqueeze(-1) * known).sum(-2)
        solution.insert(0, value)
    nothing = matrix.new_zeros(matrix.shape[:-2], dtype=torch.int32)
    return torch.stack(solution, -2), nothing


_REPLACEMENTS: dict[Any, Callable[..., Any]] = {
    torch.where: _where,
    torch.fmin: _fmin,
    torch.hypot: _hypot,
    torch.frexp: _frexp,
    torch.linalg.solve_triangular: _solve_triangular,
    torch.linalg.solve_ex: _solve_ex,
}
