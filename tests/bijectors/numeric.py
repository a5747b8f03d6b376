"""Derivatives by other means than the package's own."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def jacobian(function: Callable[[Tensor], Tensor], point: Tensor) -> Tensor:
    """Return the jacobians ``(*batch, d, d)`` of a batched function by autograd."""
    point = point.detach().requires_grad_()
    value = function(point)
    rows = [
        torch.autograd.grad(value[..., i].sum(), point, retain_graph=True)[0]
        for i in range(value.shape[-1])
    ]
    return torch.stack(rows, dim=-2)


def log_abs_det(function: Callable[[Tensor], Tensor], point: Tensor) -> Tensor:
    """Return log|det| ``(*batch,)`` of the jacobian by autograd."""
    return torch.linalg.slogdet(jacobian(function, point)).logabsdet


def central_difference(
    function: Callable[[Tensor], Tensor], point: Tensor, direction: Tensor, step: float
) -> Tensor:
    """Return the directional derivative of a function by a fourth-order central difference."""

    def slope(h: float) -> Tensor:
        return (function(point + h * direction) - function(point - h * direction)) / (2 * h)

    return (4 * slope(step / 2) - slope(step)) / 3
