r"""Hyperbolic functions of squashes, with values and gradients stable at any argument.

The radial functions take :math:`q = \rho^2`, in which they are smooth at 0; below `SMALL` they are
their power series, whose first neglected term is under float64's rounding error there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import softplus

SMALL = 0.01

# Above it softplus(x) = x in float64; torch's own threshold of 20 leaves an error of 4e-9. With
# beta = 2 torch's softplus is half of softplus(2x), and the threshold is one for 2x.
_SOFTPLUS_IS_IDENTITY = 40.0

# Coefficients of q^0, q^1, ... of tanh(rho)/rho, log(tanh(rho)/rho), log(1 - tanh(rho)^2) and
# artanh(rho)/rho: Taylor series (DLMF 4.33.3, 4.38.5 and their logarithms).
_TANHC = (1.0, -1 / 3, 2 / 15, -17 / 315, 62 / 2835, -1382 / 155925, 21844 / 6081075)
_LOG_TANHC = (0.0, -1 / 3, 7 / 90, -62 / 2835, 127 / 18900, -146 / 66825, 1414477 / 1915538625)
_LOG_SECH_SQUARED = (0.0, -1.0, 1 / 6, -2 / 45, 17 / 1260, -62 / 14175, 691 / 467775)
_ATANHC = tuple(1 / (2 * k + 1) for k in range(8))


def log_half_sech(x: Tensor) -> Tensor:
    r"""Return :math:`\log(\mathrm{sech}(x)/2) = x - \mathrm{softplus}(2x)`."""
    return torch.sub(x, softplus(x, beta=2, threshold=_SOFTPLUS_IS_IDENTITY), alpha=2)


def log_sech_squared(x: Tensor) -> Tensor:
    r"""Return :math:`L(x) = \log(1 - \tanh^2 x)`."""
    return 2 * (math.log(2) + log_half_sech(x))


def tanhc(q: Tensor) -> Tensor:
    r"""Return :math:`\tanh(\rho)/\rho` of :math:`q = \rho^2 \ge 0`."""
    small = q < SMALL
    rho = torch.where(small, 1.0, q).sqrt()
    return torch.where(small, _series(_TANHC, torch.where(small, q, 0.0)), rho.tanh() / rho)


def radial_log_det(q: Tensor, dim: int) -> Tensor:
    r"""Return log|det| of the radial squash :math:`z \mapsto \tanh(\rho)\, z/\rho` of R^d.

    :math:`L(\rho) + (d - 1) \log(\tanh(\rho)/\rho)` at :math:`q = \rho^2 = |z|^2`.
    """
    small = q < SMALL
    near_q = torch.where(small, q, 0.0)
    rho = torch.where(small, 1.0, q).sqrt()
    near, far = _series(_LOG_SECH_SQUARED, near_q), log_sech_squared(rho)
    if dim > 1:
        near = near + (dim - 1) * _series(_LOG_TANHC, near_q)
        far = far + (dim - 1) * (rho.tanh().log() - rho.log())
    return torch.where(small, near, far)


def atanhc(q: Tensor) -> Tensor:
    r"""Return :math:`\mathrm{artanh}(\rho)/\rho` of :math:`q = \rho^2 \in [0, 1)`."""
    small = q < SMALL
    rho = torch.where(small, 0.5, q).sqrt()
    return torch.where(small, _series(_ATANHC, torch.where(small, q, 0.0)), rho.atanh() / rho)


def _series(coefficients: Sequence[float], q: Tensor) -> Tensor:
    total = torch.full_like(q, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total = total * q + coefficient
    return total
