"""Norms that neither overflow nor underflow where the dtype can hold the result, and sums."""

from __future__ import annotations

from functools import reduce

import torch
from torch import Tensor
from torch.linalg import vector_norm

_MANY = 4096
"""The size from which on adding few components takes less time than `torch.sum` of them."""


def component_sum(values: Tensor) -> Tensor:
    """Return the sum over the last dimension, ``(*batch,)``.

    `torch.sum` adds up rows of two or three numbers one by one, in three times the time at large
    batches; at small ones its gradient is faster.

    Args:
        values: Values of the components, ``(*batch, d)``.
    """
    is_slow = 1 < values.shape[-1] <= 3 and not torch.compiler.is_compiling()
    if is_slow and values.numel() >= _MANY:
        return reduce(torch.add, values.unbind(-1))
    return values.sum(-1)


def power_of_two(size: Tensor) -> Tensor:
    """Return the largest powers of two up to the sizes, and 1 for sizes of 0, infinity and NaN.

    They are units to compute in: division by them changes exponents alone, so that nothing is
    rounded. They have no gradient.
    """
    size = size.detach()
    mantissa, _ = torch.frexp(size)
    # 0 by itself, not by 0/0, which is NaN only where no rounding has touched the mantissa.
    return (size / (2 * mantissa)).nan_to_num(1.0).masked_fill(size == 0, 1.0)


def length(vector: Tensor) -> Tensor:
    """Return the Euclidean norm, ``(*batch,)``, of vectors whose squares may be out of range.

    `torch.linalg.vector_norm` gives 0 for lengths below 1e-23 in float32, and infinity above 1e19.

    Args:
        vector: Vectors ``(*batch, d)``.
    """
    if vector.dtype == torch.float32:
        # Squares of float32 are in range in float64, which takes fewer passes than a unit does.
        return vector_norm(vector, dim=-1, dtype=torch.float64).to(vector.dtype)
    unit = power_of_two(vector.abs().amax(-1))
    return unit * vector_norm(vector / unit.unsqueeze(-1), dim=-1)


def spectral_norm_bound(matrix: Tensor) -> Tensor:
    r"""Return a bound of the spectral norm, :math:`\min(\sqrt{|M|_1 |M|_\infty}, |M|_F)`.

    Exact where M is diagonal and where it has one row or one column.

    Args:
        matrix: Matrices M, ``(*batch, m, d)``.
    """
    if 0 in matrix.shape[-2:]:
        return matrix.new_zeros(matrix.shape[:-2])
    size = matrix.abs()
    unit = size.amax((-2, -1))
    size = size / unit.masked_fill(unit == 0, 1)[..., None, None]
    bound = (size.sum(-1).amax(-1) * size.sum(-2).amax(-1)).sqrt()
    return unit * torch.minimum(bound, vector_norm(size, dim=(-2, -1)))
