"""The constrained flow as a distribution: densities, samples, scores, what TorchRL asks of it."""

from __future__ import annotations

import math
import re
import weakref

import numpy as np
import pytest
import torch
from mpmath import mpf
from numpy.polynomial.legendre import leggauss
from torch import Tensor
from torch.distributions import Categorical, Distribution, Independent, Normal
from torchrl.modules import TanhNormal
from torchrl.modules.distributions.utils import rsample_and_log_prob, sample_and_log_prob

from cnfp_torchrl.bijectors import GaugeSquash
from cnfp_torchrl.distributions import ConstrainedFlow, ReferenceEntropyFlow
from cnfp_torchrl.geometry import Ball, Box, HalfSpaces, Region
from tests.bijectors import reference
from tests.bijectors.cases import BY_NAME, CASES, DTYPES, PLANE, Case, cast, tensor

ids = {"ids": lambda case: case.name}
LINE = [case for case in CASES if case.dim == 1 and not case.batch_shape and not case.saturates]
# In tight regions most of the mass lies where no float resolves its latent.
SATURATING = [case for case in CASES if case.dim <= 2 and case.saturates and case.tightness < 1e3]


def gaussian(loc: Tensor, scale: Tensor) -> Independent:
    return Independent(Normal(loc, scale), 1)


def flow(case: Case, dtype: torch.dtype, scale: float = 0.6) -> ConstrainedFlow:
    """Return the case's flow of a Gaussian near 0."""
    loc = torch.linspace(-0.3, 0.4, case.dim, dtype=dtype).expand((*case.batch_shape, case.dim))
    return ConstrainedFlow(gaussian(loc, torch.full_like(loc, scale)), case.build(dtype))


# Densities ----------------------------------------------------------------------------------------


def in_the_plane(case: Case) -> object:
    # A ray past rectangles costs much more than one in a convex set.
    marks = [pytest.mark.slow] if "visible" in case.name else []
    return pytest.param(case, id=case.name, marks=marks)


@pytest.mark.parametrize("case", [in_the_plane(case) for case in PLANE if not case.saturates])
def test_density_integrates_to_one_in_the_plane(case: Case) -> None:
    """By the midpoint rule on a grid that is finer towards the anchor, where the density varies.

    A grid twice as fine has about a third of the error, which is measured to be half of what is
    allowed here. A chain's image is narrow in its last set, and an anchor 1e-4 from a boundary
    needs a much finer grid there: those get less far.
    """
    count, power, close = 160, 2, 2e-3
    if case.kind == "chain":
        close = 1e-2
    if "tight" in case.name:
        count, power, close = 240, 6, 3e-2
    box = case.sets[-1 if case.kind == "chain" else 0].bounding_box()
    anchor = (box.low + box.high) / 2 if case.anchor is None else case.anchor
    middles = (2 * torch.arange(count, dtype=torch.float64) + 1) / count - 1
    grid = torch.cartesian_prod(middles, middles).reshape(-1, *[1] * len(case.batch_shape), 2)
    reach = torch.where(grid > 0, box.high - anchor, anchor - box.low)
    action = anchor + grid.sign() * grid.abs() ** power * reach
    area = (2 * reach * power * grid.abs() ** (power - 1) / count).prod(-1)
    density = flow(case, torch.float64, 0.5).log_prob(action.expand(-1, *case.batch_shape, 2)).exp()
    assert ((density * area).sum(0) - 1).abs().max() < close


@pytest.mark.parametrize("case", LINE, **ids)
def test_density_integrates_to_one_on_the_line(case: Case) -> None:
    """By Gauss's rule, on both sides of the anchor, where the density may jump."""
    boxes = [constraint_set.bounding_box() for constraint_set in case.sets]
    low = torch.stack([box.low for box in boxes]).amax(0)
    high = torch.stack([box.high for box in boxes]).amin(0)
    anchor = (low + high) / 2 if case.anchor is None else case.anchor
    nodes, weights = map(torch.from_numpy, leggauss(200))
    distribution, total = flow(case, torch.float64), 0.0
    for end in (low, high):
        action = anchor + (nodes.unsqueeze(-1) + 1) / 2 * (end - anchor)
        total += (distribution.log_prob(action).exp() * weights).sum() / 2 * (end - anchor).abs()
    assert float(total) == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("case", [in_the_plane(case) for case in SATURATING])
def test_density_that_grows_at_the_boundary_integrates_to_one(case: Case) -> None:
    """In polar coordinates about the anchor, by the tanh-sinh rule along each ray.

    These densities vary most where a grid has no points: their slope vanishes at the boundary.
    """
    angles = 1 if case.dim == 1 else 720
    u = torch.linspace(-3.2, 2.7, 281, dtype=torch.float64)
    share = torch.sigmoid(math.pi * u.sinh())
    weights = (u[1] - u[0]) * math.pi * u.cosh() * share * torch.sigmoid(-math.pi * u.sinh())
    if case.dim == 1:
        rays, arc = torch.tensor([[-1.0], [1.0]], dtype=torch.float64), 1.0
    else:
        arc = 2 * math.pi / angles
        angle = arc * (torch.arange(angles, dtype=torch.float64) + 0.5)
        rays = torch.stack([angle.cos(), angle.sin()], -1)
    rays = rays.view(len(rays), *[1] * len(case.batch_shape), case.dim)
    rays = rays.expand(-1, *case.batch_shape, -1)
    region = case.region(torch.float64)
    end = 1 / region.gauges(rays)[-1]
    radius = share.view(-1, *[1] * end.ndim) * end
    density = (
        flow(case, torch.float64, 0.5).log_prob(region.anchor + radius.unsqueeze(-1) * rays).exp()
    )
    along = weights.view(-1, *[1] * end.ndim) * end
    total = (density * radius ** (case.dim - 1) * along * arc).sum((0, 1))
    # Off by a tenth of this where the boundary has corners, else by 1e-7 at most.
    assert (total - 1).abs().max() < 5e-4


@pytest.mark.parametrize("case", [BY_NAME["gauge-box-ball-d2"], BY_NAME["radial-ball-d2"]], **ids)
def test_samples_follow_the_density(case: Case) -> None:
    """Their share in random half-planes is the density's integral there."""
    distribution = flow(case, torch.float64)
    count = 40_000
    sample = distribution.sample((count,))
    box = case.sets[0].bounding_box()
    middles = (torch.arange(300, dtype=torch.float64) + 0.5) / 300
    action = box.low + torch.cartesian_prod(middles, middles) * (box.high - box.low)
    weight = distribution.log_prob(action).exp()
    weight = weight / weight.sum()
    for _ in range(5):
        normal = torch.randn(2, dtype=torch.float64)
        offset = (sample[0] * normal).sum()
        expected = weight[(action * normal).sum(-1) <= offset].sum().item()
        share = ((sample * normal).sum(-1) <= offset).double().mean().item()
        # Five standard errors, and the width of a cell.
        assert share == pytest.approx(expected, abs=5 * 0.5 / math.sqrt(count) + 0.005)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("case", CASES, **ids)
def test_joint_and_inverse_scores_agree(case: Case, dtype: torch.dtype) -> None:
    if case.tightness > 1e3 and dtype == torch.float32:
        pytest.skip("float32 does not resolve the action enough to find its latent")
    distribution = flow(case, dtype, 0.3)
    for sample, log_prob in (
        distribution.rsample_and_log_prob((20,)),
        distribution.sample_and_log_prob((20,)),
    ):
        # Not the density of the draw, which is kept for the very tensor that was drawn.
        again = distribution.log_prob(sample.clone())
        assert again.shape == log_prob.shape == (20, *case.batch_shape)
        if case.saturates:  # an inverse is promised only where the slope has not vanished
            region = case.region(dtype)
            inside = region.gauges(sample - region.anchor)[-1] < 0.9
            again, log_prob = again[inside], log_prob[inside]
        # In float32 the inverse's error is that of the action, amplified by the inverse jacobian.
        if dtype == torch.float64:
            torch.testing.assert_close(again, log_prob, rtol=1e-9, atol=1e-9 * case.tightness)
        elif case.dim < 32 and "far" not in case.name:
            torch.testing.assert_close(again, log_prob, rtol=2e-3, atol=2e-4 * case.tightness)


@pytest.mark.parametrize("case", CASES, **ids)
def test_log_prob_outside_is_minus_infinity(case: Case) -> None:
    distribution = flow(case, torch.float32)
    for size in (3.0, 1e6, torch.inf):
        action = size * case.size * torch.ones(2, *case.batch_shape, case.dim)
        action = torch.where(
            torch.tensor([True, False]).reshape(2, *[1] * (action.ndim - 1)), action, -action
        )
        assert distribution.log_prob(action).eq(-torch.inf).all()
        assert not distribution.support.check(action).any()


@pytest.mark.parametrize("case", CASES, **ids)
def test_nan_has_no_density(case: Case) -> None:
    distribution = flow(case, torch.float32)
    action = distribution.sample()
    action[..., 0] = torch.nan
    assert distribution.log_prob(action).isnan().all()
    beyond = action.clone()
    beyond[..., 1:] = torch.inf
    assert distribution.log_prob(beyond).isnan().all()
    nowhere = ConstrainedFlow(
        gaussian(torch.full_like(action, torch.nan), torch.ones_like(action)), distribution.bijector
    )
    sample, log_prob = nowhere.rsample_and_log_prob()
    assert sample.isnan().any(-1).all()
    assert log_prob.isnan().all()


@pytest.mark.parametrize(
    "name",
    [
        "box-d3-batch",
        "ball-d3-batch",
        "ball-box-d2",
        "gauge-ball-d2",
        "gauge-dropped-d3-batch",
        "radial-ball-d2",
        "gauge-ball-d1",
    ],
)
@pytest.mark.parametrize("loc", [-40.0, -20.0, 20.0, 40.0])
def test_saturated_float32_scores_match_mpmath(name: str, loc: float) -> None:
    """The score is that of the noise that was drawn, which the saturated action has lost.

    So has the latent where the scale is small: at 1e-8 beside 20 it is the location itself.
    """
    case = BY_NAME[name]
    bijector = case.build(torch.float32)
    index = (0,) * len(case.batch_shape)
    exact_flow = case.reference(index)
    for scale in (1e-8, 1e-3, 1.0, 1e4):
        shape = (*case.batch_shape, case.dim)
        base = gaussian(torch.full(shape, loc), torch.full(shape, scale))
        torch.manual_seed(1)
        latent = base.rsample()[index]
        torch.manual_seed(1)
        noise = gaussian(torch.zeros(shape), torch.ones(shape)).rsample()[index]
        torch.manual_seed(1)
        action, log_prob = ConstrainedFlow(base, bijector).rsample_and_log_prob()
        assert case.allows(action).all()
        z = [mpf(value) for value in latent.tolist()]
        width = mpf(torch.tensor(scale).item())
        drawn = [width * mpf(value) for value in noise.tolist()]
        of_base = reference.normal_log_prob(drawn, [mpf(0)] * case.dim, [width] * case.dim)
        _, log_det = exact_flow(z)
        # Rounding of the two terms, and the seam left by erosion.
        rounding = 4e-7 * float(abs(of_base) + abs(log_det))
        assert abs(log_prob[index].item() - (of_base - log_det)) < rounding + 4e-6 * case.dim * (
            case.tightness
        )


# Where nothing binds ------------------------------------------------------------------------------

LOW, HIGH = tensor(-1.0, -0.5, -3.0), tensor(1.0, 2.0, 1.5)
LOOSE = {
    "bounds alone": ((), None),
    "a ball around the bounds": ((Ball(tensor(0.3, 0.0, 0.0), tensor(10.0).squeeze()),), None),
    "half-spaces far away": ((HalfSpaces(torch.eye(3).double(), tensor(50.0, 50.0, 50.0)),), None),
    "a dropped ball": (
        (Ball(tensor(90.0, 0.0, 0.0), tensor(0.5).squeeze()),),
        torch.tensor([True, False]),
    ),
}


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", LOOSE)
def test_equals_tanh_normal_where_nothing_binds(name: str, dtype: torch.dtype) -> None:
    """Values, scores and gradients, up to the erosion of 16 units of rounding error."""
    sets, active = LOOSE[name]
    sets = tuple(cast(constraint_set, dtype) for constraint_set in (Box(LOW, HIGH), *sets))
    bijector = GaugeSquash(Region(sets, tensor(0.1, 0.3, -0.4).to(dtype), active))
    eroded = 32 * torch.finfo(dtype).eps * 3
    results = []
    for kind in ("flow", "TanhNormal"):
        loc = torch.linspace(-1.5, 1.5, 300, dtype=dtype).reshape(100, 3).requires_grad_()
        scale = torch.linspace(0.1, 1.0, 300, dtype=dtype).reshape(100, 3).requires_grad_()
        torch.manual_seed(3)
        if kind == "flow":
            distribution: Distribution = ConstrainedFlow(gaussian(loc, scale), bijector)
        else:
            distribution = TanhNormal(loc, scale, low=LOW.to(dtype), high=HIGH.to(dtype))
        action, log_prob = distribution.rsample_and_log_prob()
        of_action = torch.autograd.grad(action.sum(), (loc, scale), retain_graph=True)
        of_log_prob = torch.autograd.grad(log_prob.sum(), (loc, scale))
        mean = distribution.deterministic_sample
        results.append((action, log_prob, mean, *of_action, *of_log_prob))
    for mine, theirs in zip(*results, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=8 * eroded, atol=8 * eroded)


def test_reference_flow_leaves_out_the_retractions() -> None:
    case = BY_NAME["gauge-all-families-d3-batch"]
    true = flow(case, torch.float64)
    entropic = ReferenceEntropyFlow(true.base_dist, true.bijector)
    for draw in ("rsample_and_log_prob", "sample_and_log_prob"):
        torch.manual_seed(0)
        action, log_prob = getattr(true, draw)((50,))
        torch.manual_seed(0)
        same, reference_log_prob = getattr(entropic, draw)((50,))
        torch.testing.assert_close(same, action, rtol=0, atol=0)
        torch.manual_seed(0)
        bounded = true.stages(true.base_dist.sample((50,))).actions[0]
        assert case.anchor is not None
        share = (action - case.anchor).norm(dim=-1) / (bounded - case.anchor).norm(dim=-1)
        torch.testing.assert_close(reference_log_prob - log_prob, case.dim * share.log())
        assert (share < 0.9).any()
    # Of a copy, because the density of the very draw is that of its latent.
    given = action.clone()
    torch.testing.assert_close(entropic.log_prob(given), true.log_prob(given), rtol=0, atol=0)


@pytest.mark.parametrize(
    "case", [case for case in CASES if case.kind in ("squash", "chain")], **ids
)
def test_reference_flow_of_squashes_is_the_flow(case: Case) -> None:
    true = flow(case, torch.float64)
    torch.manual_seed(0)
    _, log_prob = true.rsample_and_log_prob()
    torch.manual_seed(0)
    _, same = ReferenceEntropyFlow(true.base_dist, true.bijector).rsample_and_log_prob()
    torch.testing.assert_close(same, log_prob, rtol=0, atol=0)


# What TorchRL asks for ----------------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES, **ids)
def test_deterministic_actions_are_allowed(case: Case) -> None:
    one = torch.ones(*case.batch_shape, case.dim)
    z = torch.stack([loc * one for loc in (0.0, 0.7, -50.0, 1e6)])
    distribution = ConstrainedFlow(gaussian(z, torch.ones_like(z)), case.build(torch.float32))
    for action in (distribution.deterministic_sample, distribution.mode, distribution.mean):
        assert case.allows(action).all()
        torch.testing.assert_close(action, distribution.bijector(z), rtol=0, atol=0)


def test_scores_keep_the_gradients_that_losses_need() -> None:
    case = BY_NAME["gauge-ball-d2"]
    loc = torch.zeros(5, 2, requires_grad=True)
    distribution = ConstrainedFlow(gaussian(loc, torch.ones(5, 2)), case.build(torch.float32))
    action, log_prob = rsample_and_log_prob(distribution, (7,))
    assert action.requires_grad
    assert log_prob.requires_grad
    action, log_prob = sample_and_log_prob(distribution, (7,))
    assert not action.requires_grad
    # The score function: its mean gradient is that of the base's log-density.
    latent = distribution.bijector.inverse_and_log_det(action)[0]
    (gradient,) = torch.autograd.grad(log_prob.sum(), loc)
    torch.testing.assert_close(gradient, (latent - loc.detach()).sum(0), rtol=1e-3, atol=1e-3)
    assert not distribution.sample().requires_grad


class WithoutReparametrization(Independent):
    """A base whose samples have no gradients."""

    has_rsample = False

    def rsample(self, sample_shape: torch.Size = torch.Size()) -> Tensor:  # noqa: B008
        raise NotImplementedError


def test_base_need_not_be_reparametrized() -> None:
    case = BY_NAME["gauge-ball-d2"]
    base = WithoutReparametrization(Normal(torch.zeros(2), torch.ones(2)), 1)
    distribution = ConstrainedFlow(base, case.build(torch.float32))
    assert not distribution.has_rsample
    action, log_prob = distribution.sample_and_log_prob((3,))
    assert case.allows(action).all()
    assert log_prob.shape == (3,)
    assert case.allows(distribution.sample((3,))).all()


@pytest.mark.parametrize("batch", [(), (1,), (4,), (5, 1), (5, 4)])
def test_base_is_expanded_to_the_sets(batch: tuple[int, ...]) -> None:
    """Each set of the batch has samples of its own, whichever side has the larger batch."""
    case = BY_NAME["gauge-dropped-d3-batch"]
    base = gaussian(torch.zeros(*batch, 3), torch.ones(*batch, 3))
    distribution = ConstrainedFlow(base, case.build(torch.float32))
    whole = torch.broadcast_shapes(batch, (4,))
    assert distribution.batch_shape == whole
    assert distribution.event_shape == (3,)
    for shape in ((), (6,), (2, 3)):
        action, log_prob = distribution.rsample_and_log_prob(shape)
        assert action.shape == (*shape, *whole, 3)
        assert log_prob.shape == (*shape, *whole)
        assert distribution.log_prob(action).shape == log_prob.shape
        assert distribution.sample(shape).shape == distribution.rsample(shape).shape == action.shape
        assert case.allows(action).all()
    rows = distribution.base_dist.sample().reshape(-1, 3)
    assert len(rows.unique(dim=0)) == len(rows)
    stages = distribution.stages(distribution.base_dist.sample((2,)))
    assert stages.actions.shape == (4, 2, *whole, 3)


@pytest.mark.parametrize("kind", [ConstrainedFlow, ReferenceEntropyFlow])
def test_expand(kind: type[ConstrainedFlow]) -> None:
    case = BY_NAME["gauge-dropped-d3-batch"]
    distribution = kind(gaussian(torch.zeros(4, 3), torch.ones(4, 3)), case.build(torch.float32))
    expanded = distribution.expand((5, 4))
    assert type(expanded) is kind
    assert expanded.batch_shape == (5, 4)
    assert expanded.rsample_and_log_prob((2,))[0].shape == (2, 5, 4, 3)


# What it refuses ----------------------------------------------------------------------------------


def test_bad_bases_are_refused() -> None:
    plane = BY_NAME["gauge-ball-d2"].build(torch.float32)
    for base, message in (
        (
            Normal(torch.zeros(2), torch.ones(2)),
            "base: expected a distribution over vectors (event_shape (d,)), given Normal with "
            "event_shape ()",
        ),
        (Categorical(torch.ones(2)), "given Categorical with event_shape ()"),
        (
            gaussian(torch.zeros(3), torch.ones(3)),
            "base: expected event_shape (2,), the bijector's action dimension, given (3,)",
        ),
        (gaussian(torch.zeros(4, 1), torch.ones(4, 1)), "expected event_shape (2,)"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            ConstrainedFlow(base, plane)


def assert_draws_are_refused(distribution: ConstrainedFlow, message: str) -> None:
    for draw in (
        distribution.rsample_and_log_prob,
        distribution.sample_and_log_prob,
        distribution.rsample,
        distribution.sample,
        lambda: distribution.mode,
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            draw()


def test_a_coarser_base_is_refused() -> None:
    """Its rounding errors exceed the margin of sets of float64."""
    base = gaussian(torch.zeros(2), torch.ones(2))
    distribution = ConstrainedFlow(base, BY_NAME["gauge-ball-d2"].build(torch.float64))
    message = "base: expected samples of torch.float64, as the bijector's sets are, given torch.flo"
    assert_draws_are_refused(distribution, message)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_refused(dtype: torch.dtype) -> None:
    base = gaussian(torch.zeros(2, dtype=dtype), torch.ones(2, dtype=dtype))
    distribution = ConstrainedFlow(base, BY_NAME["gauge-ball-d2"].build(torch.float32))
    message = f"base: expected samples of float32 or float64, given {dtype}; convert"
    assert_draws_are_refused(distribution, message)


def test_a_base_that_checks_its_arguments() -> None:
    base = Independent(Normal(torch.zeros(2), torch.ones(2), validate_args=True), 1)
    distribution = ConstrainedFlow(base, BY_NAME["gauge-ball-d2"].build(torch.float32))
    assert distribution.log_prob(torch.tensor([torch.nan, 0.0])).isnan()
    assert distribution.log_prob(torch.tensor([torch.inf, 0.0])) == -torch.inf


@pytest.mark.parametrize("batch", [(0,), (2, 0), (0, 3)])
def test_empty_batches(batch: tuple[int, ...]) -> None:
    base = gaussian(torch.zeros(*batch, 2), torch.ones(*batch, 2))
    distribution = ConstrainedFlow(base, BY_NAME["gauge-ball-d2"].build(torch.float32))
    for action, log_prob in (
        distribution.rsample_and_log_prob(),
        distribution.sample_and_log_prob(),
    ):
        assert action.shape == (*batch, 2)
        assert log_prob.shape == distribution.log_prob(action).shape == batch


def test_nothing_here_depends_on_numpys_random_numbers() -> None:
    """Seeding PyTorch makes a draw repeatable."""
    distribution = flow(BY_NAME["gauge-ball-d2"], torch.float32)
    draws = []
    for seed in (0, 1):
        np.random.seed(seed)  # noqa: NPY002
        torch.manual_seed(7)
        draws.append(distribution.sample((3,)))
    assert torch.equal(*draws)


# Densities of own samples -------------------------------------------------------------------------


def scored_jointly(distribution: ConstrainedFlow, draw: str) -> tuple[Tensor, Tensor]:
    """Return an action drawn alone, and the score that drawing both together gives."""
    torch.manual_seed(5)
    _, log_prob = getattr(distribution, f"{draw}_and_log_prob")((30,))
    torch.manual_seed(5)
    return getattr(distribution, draw)((30,)), log_prob


@pytest.mark.parametrize(
    ("draw", "scale"), [("sample", 0.3), ("rsample", 5.0), ("sample", 100.0), ("rsample", 100.0)]
)
@pytest.mark.parametrize("case", CASES, **ids)
def test_own_samples_have_the_density_of_their_draw(case: Case, scale: float, draw: str) -> None:
    distribution = flow(case, torch.float32, scale)
    action, log_prob = scored_jointly(distribution, draw)
    assert log_prob.isfinite().all()
    torch.testing.assert_close(distribution.log_prob(action), log_prob, rtol=1e-4, atol=1e-3)


def test_own_samples_keep_the_gradients_of_their_draw() -> None:
    bijector = BY_NAME["gauge-ball-d2"].build(torch.float64)
    gradients = []
    for apart in (False, True):
        for draw in ("sample", "rsample"):
            loc = torch.full((4, 2), 8.0, dtype=torch.float64, requires_grad=True)
            distribution = ConstrainedFlow(gaussian(loc, torch.ones_like(loc)), bijector)
            action, log_prob = scored_jointly(distribution, draw)
            score = distribution.log_prob(action) if apart else log_prob
            gradients.append(torch.autograd.grad(score.sum(), loc)[0])
    torch.testing.assert_close(gradients[2:], gradients[:2])


def test_only_the_very_draw_has_its_density() -> None:
    """A copy, a changed action, an older draw are given actions: the boundary has no density."""
    distribution = flow(BY_NAME["box-d3-batch"], torch.float32, 1e4)
    older, action = distribution.sample((9,)), distribution.sample((9,))
    assert distribution.log_prob(action).isfinite().all()
    assert distribution.log_prob(action.clone()).isinf().any()
    assert distribution.log_prob(older).isinf().any()
    action.add_(0.0)
    assert distribution.log_prob(action).isinf().any()


def test_gradients_of_own_samples_can_be_asked_for_later() -> None:
    distribution = flow(BY_NAME["gauge-ball-d2"], torch.float64)
    action = distribution.sample((9,)).requires_grad_()
    (gradient,) = torch.autograd.grad(distribution.log_prob(action).sum(), action)
    again = action.detach().clone().requires_grad_()
    (expected,) = torch.autograd.grad(distribution.log_prob(again).sum(), again)
    torch.testing.assert_close(gradient, expected, rtol=0, atol=0)


def test_own_samples_in_inference_mode_and_compiled() -> None:
    bijector = BY_NAME["box-d3-batch"].build(torch.float32)

    def score(loc: Tensor) -> tuple[Tensor, Tensor]:
        base = Independent(Normal(loc, loc.new_ones(()), validate_args=False), 1)
        distribution = ConstrainedFlow(base, bijector)
        action = distribution.rsample()
        return action, distribution.log_prob(action)

    loc = torch.full((*bijector.shape,), 50.0)
    with torch.inference_mode():
        assert score(loc)[1].isfinite().all()
    compiled = torch.compile(score, fullgraph=True, backend="aot_eager")
    torch.manual_seed(2)
    expected = score(loc)
    torch.manual_seed(2)
    torch.testing.assert_close(compiled(loc), expected)


def test_a_draw_is_let_go_with_its_distribution() -> None:
    distribution = flow(BY_NAME["gauge-ball-d2"], torch.float32)
    action = weakref.ref(distribution.rsample())
    assert action() is not None
    distribution.rsample()
    assert action() is None
    action = weakref.ref(distribution.rsample())
    del distribution
    assert action() is None


@pytest.mark.parametrize(
    "value",
    [
        torch.zeros(5, 1),
        torch.tensor(0.0),
        torch.zeros(3),
        torch.zeros(5, 2, dtype=torch.long),
        torch.zeros(7, 2),
    ],
    ids=["one column", "scalar", "other width", "integers", "other batch"],
)
def test_values_of_other_shapes_are_refused(value: Tensor) -> None:
    base = gaussian(torch.zeros(5, 2), torch.ones(5, 2))
    distribution = ConstrainedFlow(base, BY_NAME["gauge-ball-d2"].build(torch.float32))
    with pytest.raises(ValueError, match=rf"value: .*d = 2, given shape .*{value.dtype}"):
        distribution.log_prob(value)


def test_entropy_says_how_to_estimate_it() -> None:
    with pytest.raises(NotImplementedError, match="rsample_and_log_prob"):
        flow(BY_NAME["gauge-ball-d2"], torch.float32).entropy()
