"""Sums of components, against torch's."""

import pytest
import torch

from cnfp_torchrl.geometry import component_sum


@pytest.mark.parametrize("batch", [(), (3,), (2, 2048), (0,)])
@pytest.mark.parametrize("dim", [1, 2, 3, 4])
def test_components_add_up_at_any_size(batch: tuple[int, ...], dim: int) -> None:
    values = torch.randn(*batch, dim, dtype=torch.float64, requires_grad=True)
    summed = component_sum(values)
    torch.testing.assert_close(summed, values.sum(-1))
    weight = torch.randn_like(summed)
    (gradient,) = torch.autograd.grad((summed * weight).sum(), values)
    torch.testing.assert_close(gradient, weight.unsqueeze(-1).expand_as(values))
