"""The projection baseline: allowed with zero tolerance, closest, smooth, without a density."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor
from torch.distributions import Independent, Normal

from cnfp_torchrl.bijectors import BoxSquash, NoDensityError, Projection
from cnfp_torchrl.distributions import ConstrainedFlow, ReferenceEntropyFlow
from cnfp_torchrl.geometry import (
    ConstraintSet,
    Ellipsoid,
    Region,
    project_onto_intersection,
)
from tests.bijectors.cases import DTYPES, Case, Maker, latents, latents_of, regions
from tests.bijectors.numeric import central_difference, jacobian

Family = Callable[[Maker], ConstraintSet]
LENGTHS = (0.0, 1e-12, 1.0, 20.0, 1e6)


@dataclass(frozen=True)
class Kind:
    """Random regions of some families.

    Args:
        families: The families of the sets after the action bounds.
        dim: The dimension d.
        size: The half-width of the action bounds.
        rounds: The rounds of Dykstra's algorithm; few, so that the last step has something to do.
    """

    families: tuple[Family, ...]
    dim: int = 2
    size: float = 1.0
    rounds: int = 2

    def case(self) -> Case:
        make = Maker(self.dim, (40,), size=self.size, slack=0.05, seed=self.dim)
        sets = (make.bounds(), *(family(make) for family in self.families))
        return Case("", "projection", sets, make.anchor)


KINDS = {
    "bounds alone": Kind(()),
    "box": Kind((Maker.box,)),
    "open box": Kind((Maker.open_box,)),
    "ball": Kind((Maker.ball,)),
    "large ball, box": Kind((Maker.large_ball, Maker.box)),
    "huge ball, box": Kind((lambda make: make.ball(73.0), Maker.box)),
    "ball, box, d = 1": Kind((Maker.ball, Maker.box), dim=1),
    "ball, box, d = 6, small": Kind((Maker.ball, Maker.box), dim=6, size=1e-3),
    "ball, box, d = 20, large": Kind((Maker.ball, Maker.box), dim=20, size=1e3),
    "two balls": Kind((Maker.ball, Maker.large_ball)),
    "half-spaces": Kind((Maker.half_spaces,)),
    "half-spaces, ball, box, d = 6": Kind((Maker.half_spaces, Maker.ball, Maker.box), dim=6),
}
ALL_KINDS = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)


def build(kind: Kind, dtype: torch.dtype = torch.float32) -> tuple[Case, Projection]:
    case = kind.case()
    return case, Projection(case.region(dtype), rounds=kind.rounds)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@ALL_KINDS
def test_every_action_is_allowed_with_zero_tolerance(kind: Kind, dtype: torch.dtype) -> None:
    case, projection = build(kind, dtype)
    action = projection(latents_of(case, 100, dtype, LENGTHS))
    assert action.dtype == dtype
    assert case.allows(action).all()
    assert projection.contains(action).all()


@ALL_KINDS
def test_it_is_the_squash_and_then_the_closest_action(kind: Kind) -> None:
    case, _ = build(kind)
    many = 500
    projection = Projection(case.region(torch.float64), rounds=many)
    latent = latents(case, 30, torch.float64, 1.0)
    bounded = BoxSquash(*case.cast(torch.float64)[0].fields().values())(latent)
    expected = project_onto_intersection(case.region(torch.float64), bounded, many)
    size = max(case.size, 73.0 if "huge" in str(kind.families) else 1.0)
    torch.testing.assert_close(projection(latent), expected, rtol=0, atol=1e-4 * size)
    assert ((expected - bounded).norm(dim=-1) > 1e-3 * case.size).any() or not kind.families


@ALL_KINDS
def test_an_allowed_action_stays_as_it_is(kind: Kind) -> None:
    case, projection = build(kind, torch.float64)
    region = case.region(torch.float64)
    way = torch.nn.functional.normalize(latents(case, 200, torch.float64, 1.0), dim=-1)
    allowed = region.anchor + 0.9 * region.slack(region.anchor).unsqueeze(-1) * way
    latent, _ = BoxSquash.onto(region.eroded().bounds).inverse_and_log_det(allowed)
    torch.testing.assert_close(projection(latent), allowed, rtol=0, atol=1e-9 * case.size)


@ALL_KINDS
def test_gradients_are_finite(kind: Kind) -> None:
    case, projection = build(kind)
    latent = latents_of(case, 100, torch.float32, LENGTHS).requires_grad_()
    projection(latent).sum().backward()
    assert latent.grad is not None
    assert latent.grad.isfinite().all()


@pytest.mark.parametrize("name", ["large ball, box", "half-spaces", "two balls"])
def test_gradients_agree_with_differences(name: str) -> None:
    case, projection = build(KINDS[name], torch.float64)
    latent = latents(case, 3, torch.float64, 1.0)
    axes = torch.eye(case.dim, dtype=torch.float64)[:, None, None]
    columns = central_difference(projection, latent, axes, 1e-6).movedim(0, -1)
    torch.testing.assert_close(jacobian(projection, latent), columns, rtol=1e-3, atol=1e-5)


def base(loc: Tensor) -> Independent[Normal]:
    return Independent(Normal(loc, torch.ones_like(loc)), 1)


def test_the_reference_entropy_is_that_before_the_projection() -> None:
    case, projection = build(KINDS["large ball, box"], torch.float64)
    latent = latents(case, 50, torch.float64, 1.0)
    _, log_det = projection.forward_and_reference_log_det(latent)
    eroded = case.region(torch.float64).eroded().bounds
    expected = BoxSquash.onto(eroded).forward_and_log_det(latent)[1]
    torch.testing.assert_close(log_det, expected)
    # Drawn and scored together, as losses do, with gradients.
    loc = latent[0].clone().requires_grad_()
    action, log_prob = ReferenceEntropyFlow(base(loc), projection).rsample_and_log_prob()
    assert case.allows(action.detach()).all()
    (action.sum() + log_prob.sum()).backward()
    assert loc.grad is not None
    assert loc.grad.isfinite().all()


REFUSED: dict[str, Callable[[Projection, Tensor], object]] = {
    "log-determinant": lambda projection, z: projection.forward_and_log_det(z),
    "log_abs_det_jacobian": lambda projection, z: projection.log_abs_det_jacobian(z, z),
    "inverse": lambda projection, z: projection.inverse_and_log_det(z),
    "inv": lambda projection, z: projection.inv(z),
    "stages": lambda projection, z: projection.stages(z),
    "log_prob": lambda projection, z: ConstrainedFlow(base(z), projection).log_prob(z * 0.01),
    "rsample_and_log_prob": lambda projection, z: ConstrainedFlow(
        base(z), projection
    ).rsample_and_log_prob(),
    "reference log_prob": lambda projection, z: ReferenceEntropyFlow(base(z), projection).log_prob(
        z
    ),
}


@pytest.mark.parametrize("ask", REFUSED.values(), ids=REFUSED)
def test_densities_are_refused(ask: Callable[[Projection, Tensor], object]) -> None:
    case, projection = build(KINDS["ball"])
    message = "Projection: it has no density.*loss.entropy=reference.*flow=exact"
    with pytest.raises(NoDensityError, match=message):
        ask(projection, latents(case, 1, torch.float32, 1.0)[0])


def test_samples_and_the_mode_need_no_density() -> None:
    case, projection = build(KINDS["ball"])
    density = ConstrainedFlow(base(latents(case, 1, torch.float32, 1.0)[0]), projection)
    for action in (density.sample((7,)), density.rsample((7,)), density.deterministic_sample):
        assert case.allows(action).all()


@pytest.mark.parametrize("rounds", [0, -1])
def test_rounds_are_checked(rounds: int) -> None:
    with pytest.raises(ValueError, match=f"rounds: expected a number >= 1, given {rounds}"):
        Projection(KINDS["box"].case().region(torch.float32), rounds=rounds)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_actions_lie_in_a_visible_region_with_zero_tolerance(dtype: torch.dtype) -> None:
    case = Case("", "projection", *regions()["visible-d2-batch"])
    projection = Projection(case.region(dtype), rounds=20)
    latent = latents_of(case, 100, dtype, LENGTHS).requires_grad_()
    action = projection(latent)
    assert case.allows(action.detach()).all()
    action.sum().backward()
    assert latent.grad is not None
    assert latent.grad.isfinite().all()


class Undescribed(Ellipsoid):
    """A family that says nothing about its shape."""

    def superlevel(self) -> None:  # type: ignore[override]
        return None


def test_sets_of_no_described_shape_are_refused() -> None:
    make = Maker(2, slack=0.05)
    given = make.ellipsoid()
    region = Region((make.bounds(), Undescribed(**given.fields())), make.anchor)
    with pytest.raises(TypeError, match=r"a set with a projection, .* given Undescribed"):
        Projection(region, rounds=1)(torch.zeros(2, dtype=torch.float64))
