"""Forward and inverse undo each other, and each allowed action has a latent."""

from __future__ import annotations

import pytest
import torch

from tests.bijectors.cases import CASES, DTYPES, PLANE, Case, latents_of
from tests.bijectors.numeric import jacobian

ids = {"ids": lambda case: case.name}


@pytest.mark.parametrize("case", CASES, **ids)
@pytest.mark.parametrize("dtype", DTYPES)
def test_inverse_undoes_forward(case: Case, dtype: torch.dtype) -> None:
    bijector = case.build(dtype)
    z = latents_of(case, 10, dtype, (0.01, 0.3, 1.0, 3.0))
    action, log_det = bijector.forward_and_log_det(z)
    found, inverse_log_det = bijector.inverse_and_log_det(action)
    again = bijector(found)

    # An action is known to a few units of rounding error of the numbers it is computed with; the
    # inverse jacobian says how much that moves its latent.
    eps = 32 * torch.finfo(dtype).eps
    exact = case.build(torch.float64)
    inverse = torch.linalg.inv(jacobian(exact, z.double()))
    moved = eps * (1 + case.size * torch.linalg.matrix_norm(inverse, 2))
    # Where float32 hardly resolves the latent, the map is not linear over its error any more.
    resolved = moved < 0.05
    # What the soft retractions promise is in test_soft_retraction.
    if not case.saturates:
        assert resolved.double().mean() > (0.3 if dtype == torch.float32 else 0.99)

    assert bijector.contains(action)[resolved].all()
    assert ((found - z).abs().amax(-1) <= moved)[resolved].all()
    scored = resolved
    if case.kind == "exact":
        # The density jumps where a component of the offset changes its sign.
        offset = exact.stages(z.double()).actions[0] - case.anchor
        scored = scored & (offset.abs() > eps * case.size).all(-1)
        assert scored.double().mean() > (0.2 if dtype == torch.float32 else 0.8)
    assert ((inverse_log_det + log_det).abs() <= 6 * case.dim * moved)[scored].all()
    assert ((again - action).abs().amax(-1) <= eps * case.size)[resolved].all()


@pytest.mark.parametrize("case", PLANE, **ids)
def test_every_allowed_action_has_a_latent(case: Case) -> None:
    """The image is the whole set: each cell of it is reached, and nothing beyond it."""
    if case.kind == "chain":
        pytest.skip("the paper's chain covers a part of its last set only")
    if "visible" in case.name:
        pytest.skip("about an anchor other than 0 the flow covers what the anchor sees")
    bijector = case.build(torch.float64)
    box = case.sets[-1 if case.kind == "squash" else 0].bounding_box()
    if case.anchor is not None:
        # The finest cells lie around the anchor, for sets that are small in their bounds.
        shares = torch.linspace(-1, 1, 81, dtype=torch.float64)
        shares = shares.abs() ** 3 * shares.sign()
        anchor = case.anchor
    else:
        shares = torch.linspace(-1, 1, 81, dtype=torch.float64)
        anchor = (box.low + box.high) / 2
    reach = torch.maximum(box.high - anchor, anchor - box.low) * 1.01
    grid = torch.cartesian_prod(shares, shares).reshape(-1, *[1] * len(case.batch_shape), 2)
    action = anchor + grid * reach
    action = action.expand(-1, *case.batch_shape, 2)
    inside = case.allows(action)
    # Erosion leaves a seam at the boundary: cells are judged whose neighbors agree with them.
    seam = 1e-12 * case.size * torch.tensor([[1.0, 0], [-1, 0], [0, 1], [0, -1]]).double()
    around = torch.stack([case.allows(action + offset) for offset in seam])
    judged = (around == inside).all(0)
    assert judged.double().mean() > 0.95
    assert inside.any(0).all()

    contained = bijector.contains(action)
    assert torch.equal(contained[judged], inside[judged])
    latent = bijector.inverse_and_log_det(torch.where(inside.unsqueeze(-1), action, anchor))[0]
    reached = inside & judged
    assert latent[reached].isfinite().all()
    error = (bijector(latent) - action).abs().amax(-1)[reached]
    assert error.max() <= 64 * torch.finfo(torch.float64).eps * case.size


@pytest.mark.parametrize("case", CASES, **ids)
def test_far_actions_are_outside(case: Case) -> None:
    bijector = case.build(torch.float32)
    for size in (10.0, 1e6, torch.inf):
        far = size * case.size * torch.ones(*case.batch_shape, case.dim)
        assert not bijector.contains(far).any()
        assert not bijector.codomain.check(-far).any()
    assert not bijector.contains(far * torch.nan).any()
