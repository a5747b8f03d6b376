"""Norms of vectors and matrices."""

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
    if 0 in matrix.shape[-2:]:
        return matrix.new_zeros(matrix.shape[:-2])
    size = matrix.abs()
    # In units of the largest element, whose square might not be a finite or a normal number.
    unit = size.amax((-2, -1))
    size = size / unit.masked_fill(unit == 0, 1)[..., None, None]
    bound = (size.sum(-1).amax(-1) * size.sum(-2).amax(-1)).sqrt()
    return unit * torch.minimum(bound, vector_norm(size, dim=(-2, -1)))
