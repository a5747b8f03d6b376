"""A bound of a matrix's norm."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.linalg import vector_norm


def spectral_norm_bound(matrix: Tensor) -> Tensor:
    r"""Return a bound of the spectral norm, :math:`\min(\sqrt{|M|_1 |M|_\infty}, |M|_F)`.

    Exact where M is diagonal and where it has one row or one column.

    Args:
        matrix: M, ``(*batch, m, d)``.
    """
    size = matrix.abs()
    bound = (size.sum(-1).amax(-1) * size.sum(-2).amax(-1)).sqrt()
    return torch.minimum(bound, vector_norm(matrix, dim=(-2, -1)))
