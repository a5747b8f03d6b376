"""The shell: not a set of its own, so its properties are tested here and not in the table."""

import numpy as np
import pytest
import torch
from torch.distributions import Independent, Normal

from cnfp_torchrl.bijectors import ShellSquash
from cnfp_torchrl.distributions import ConstrainedFlow
from cnfp_torchrl.geometry import Box, GeometryError, HalfSpaces, Region

CENTER, INNER, OUTER = 0.1, 0.3, 1.2


def shell(dim: int, *, with_region: bool, dtype: torch.dtype = torch.float64) -> ShellSquash:
    center = torch.full((dim,), CENTER, dtype=dtype)
    ones = torch.ones(dim, dtype=dtype)
    cut = HalfSpaces(ones.unsqueeze(0), torch.tensor([dim * CENTER + 0.5], dtype=dtype))
    region = Region((Box(-ones, ones), cut), center) if with_region else None
    return ShellSquash(
        center, torch.tensor(INNER, dtype=dtype), torch.tensor(OUTER, dtype=dtype), region
    )


@pytest.mark.parametrize("dim", [1, 2, 4])
@pytest.mark.parametrize("with_region", [False, True])
def test_inverse_and_log_det(dim: int, with_region: bool) -> None:
    squash = shell(dim, with_region=with_region)
    latent = 2 * torch.randn(100, dim, dtype=torch.float64)
    has_room = ~squash(latent).isnan().any(-1)
    latent = latent[has_room & (latent.norm(dim=-1) < 8)]
    assert len(latent) > 50
    action, log_det = squash.forward_and_log_det(latent)
    back, inverse_log_det = squash.inverse_and_log_det(action)
    torch.testing.assert_close(back, latent, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(inverse_log_det, -log_det, rtol=1e-6, atol=1e-6)
    jacobians = torch.stack(
        [torch.autograd.functional.jacobian(squash, row) for row in latent]  # type: ignore[arg-type]
    )
    torch.testing.assert_close(log_det, torch.linalg.slogdet(jacobians)[1], rtol=1e-9, atol=1e-9)
    assert squash.contains(action).all()


@pytest.mark.parametrize("size", [1e-12, 1.0, 20.0, 1e6])
@pytest.mark.parametrize("dim", [1, 2, 6, 32])
@pytest.mark.parametrize("with_region", [False, True])
def test_samples_lie_in_the_shell_with_zero_tolerance(
    size: float, dim: int, with_region: bool
) -> None:
    squash = shell(dim, with_region=with_region, dtype=torch.float32)
    latent = torch.nn.functional.normalize(torch.randn(20_000, dim), dim=-1) * size
    if with_region:
        # Where half-space and hole leave no room on a ray, the action is NaN by contract.
        latent = latent[~squash(latent).isnan().any(-1)]
        assert len(latent) > 1000
    action = squash(latent).double().numpy()
    distance = np.linalg.norm(action - np.float64(np.float32(CENTER)), axis=-1)
    assert (distance >= np.float64(np.float32(INNER))).all()
    assert (distance <= np.float64(np.float32(OUTER))).all()
    if with_region:
        assert (np.abs(action) <= 1).all()
        assert (action.sum(-1) <= np.float32(dim * CENTER + 0.5)).all()


def test_density_integrates_to_one() -> None:
    zeros = torch.zeros(2, dtype=torch.float64)
    flow = ConstrainedFlow(Independent(Normal(zeros, zeros + 1), 1), shell(2, with_region=False))

    # Gauss and Legendre's nodes along the radius; around the circle the density is periodic, and
    # equal steps are as exact.
    nodes, weights = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(400))
    radius = (INNER + OUTER) / 2 + (OUTER - INNER) / 2 * nodes
    angle = torch.arange(16) * (2 * torch.pi / 16)
    ray = torch.stack([angle.cos(), angle.sin()], -1)
    density = flow.log_prob(CENTER + radius[:, None, None] * ray).exp().mean(-1) * 2 * torch.pi
    total = (weights * (OUTER - INNER) / 2 * radius * density).sum()
    assert total.item() == pytest.approx(1, abs=1e-5)


def test_outside_has_no_density() -> None:
    zeros = torch.zeros(2, dtype=torch.float64)
    flow = ConstrainedFlow(Independent(Normal(zeros, zeros + 1), 1), shell(2, with_region=False))
    offsets = torch.tensor([[0.0, 0.0], [0.2, 0.0], [0.0, 1.3]], dtype=torch.float64)
    assert (flow.log_prob(CENTER + offsets) == -torch.inf).all()


def test_a_ray_without_room_is_nan_and_not_unsafe() -> None:
    ones = torch.ones(2)
    narrow = Region((Box(-ones, 0.2 * ones),), torch.zeros(2))
    squash = ShellSquash(torch.zeros(2), torch.tensor(0.5), torch.tensor(1.0), narrow)
    assert squash(torch.tensor([1.0, 0.0])).isnan().all()
    assert not squash(torch.tensor([-1.0, 0.0])).isnan().any()


@pytest.mark.parametrize(("inner", "outer"), [(0.5, 0.5), (0.6, 0.5), (0.0, 1.0), (-0.1, 1.0)])
def test_bad_radii_are_refused(inner: float, outer: float) -> None:
    with pytest.raises(GeometryError, match="0 < inner < outer"):
        ShellSquash(torch.zeros(2), torch.tensor(inner), torch.tensor(outer))
