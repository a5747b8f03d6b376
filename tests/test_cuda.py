"""On a GPU: the same results as on a CPU, no violation in float32 with TF32, and no waiting."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.distributions import Independent, Normal
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.modules import MLP, NormalParamExtractor, ValueOperator

from cnfp_torchrl import (
    Ball,
    Box,
    ConstrainedFlow,
    ConstraintSet,
    Ellipsoid,
    GeometryTransform,
    HalfSpaces,
    PositivePart,
    Region,
    WeightedL1Ball,
    constrain_env,
    make_constrained_actor,
)
from cnfp_torchrl.bijectors import Bijector, ExactSquash, GaugeSquash, RadialSquash
from cnfp_torchrl.envs import ActionGuard
from cnfp_torchrl.objectives import ConstrainedSACLoss, FusedSoftUpdate
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.training.update import Update
from experiments.benchmarks.waits import waits
from tests.host_reads import no_synchronization

pytestmark = [
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU that CUDA can use"),
    pytest.mark.filterwarnings("ignore::cnfp_torchrl.envs.RelaxedEverywhereWarning"),
]

SQUASHES: dict[str, Callable[..., Bijector]] = {
    "exact": ExactSquash,
    "gauge": GaugeSquash,
    "radial": RadialSquash,
}
DIM = 3


class Limit(GeometryTransform):
    """A wall that leaves no action in states far on the left."""

    def constraint_set(self, tensordict: TensorDictBase) -> HalfSpaces:
        x = tensordict["observation"][..., :1]
        normals = torch.zeros_like(x).unsqueeze(-1).repeat_interleave(2, -1)
        normals[..., 0] = 1
        return HalfSpaces(normals, 4 * x, validate_args=False)


def environment(agents: int, device: str = "cuda", *, relaxed: bool = False) -> TransformedEnv:
    """Return point navigation, with states in which the wall gives way if wanted."""
    base = PointNavEnv([agents], device=device, seed=0)
    limits = [Limit("limit")] if relaxed else []
    return constrain_env(base, *limits, BatteryGeometry(), ObstacleGeometry())


def actor_of(env: TransformedEnv, scale: float = 1.0) -> nn.Module:
    network = nn.Sequential(MLP(5, 4, num_cells=[32], device=env.device), NormalParamExtractor())
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(scale)
    return make_constrained_actor(network, env)


def random_sets(batch: int, *, impossible: bool) -> list[ConstraintSet]:
    """Return bounds and sets of several families in float64, some of which cannot be had."""
    torch.manual_seed(0)
    middle = 0.6 * torch.rand(batch, DIM).double() - 0.3
    if impossible:
        middle = torch.where(torch.rand(batch, 1) < 0.3, 4 * middle.sign(), middle)
    normals = torch.randn(batch, 2, DIM).double()
    offsets = (normals * middle.unsqueeze(-2)).sum(-1) + 0.2
    tril = torch.randn(batch, DIM, DIM).double().tril(-1) + 0.7 * torch.eye(DIM).double()
    weights = torch.randn(batch, DIM).double()
    reach = (weights * middle).abs().sum(-1)
    return [
        Box(-torch.ones(DIM).double(), torch.ones(DIM).double()),
        PositivePart(weights, reach + 0.3),
        WeightedL1Ball(weights, reach + 0.2),
        Ellipsoid(middle, tril),
        HalfSpaces(normals, offsets),
        Box(middle - 0.3, middle + 0.4),
        Ball(middle + 0.1, torch.full((batch,), 0.5).double()),
    ]


def moved(region: Region, **to: object) -> Region:
    return region.to(**to)  # type: ignore[arg-type]


@contextmanager
def tf32() -> Iterator[None]:
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


@pytest.mark.parametrize("impossible", [False, True])
def test_anchors_and_amounts_are_those_of_the_cpu(impossible: bool) -> None:
    sets = random_sets(512, impossible=impossible)
    here = Region.build(sets)
    there = Region.build([constraint_set.to(device="cuda") for constraint_set in sets])
    assert there.anchor.is_cuda
    assert torch.equal(there.is_active.cpu(), here.is_active)
    assert bool((~here.is_active).any()) == impossible
    # Certified within 2 % of a depth of 5e-5 on both.
    torch.testing.assert_close(there.amounts().cpu(), here.amounts(), rtol=1e-3, atol=3e-6)
    assert bool((moved(there, device="cpu").slack(there.anchor.cpu()) > 0).all())


@pytest.mark.parametrize("name", SQUASHES)
def test_float32_on_the_gpu_agrees_with_float64_on_the_cpu(name: str) -> None:
    region = Region.build(random_sets(4096, impossible=False))
    latent = torch.randn(4096, DIM).double()

    def scored(region: Region, latent: Tensor) -> tuple[Tensor, Tensor]:
        zeros, ones = torch.zeros_like(latent), torch.ones_like(latent)
        flow = ConstrainedFlow(Independent(Normal(zeros, ones), 1), SQUASHES[name](region))
        return flow.bijector.forward_and_log_det(latent)

    expected, log_det = scored(region, latent)
    double = scored(moved(region, device="cuda"), latent.cuda())
    torch.testing.assert_close(double[0].cpu(), expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(double[1].cpu(), log_det, rtol=1e-10, atol=1e-10)
    with tf32():
        single = moved(region, dtype=torch.float32, device="cuda")
        action, score = scored(single, latent.float().cuda())
    # Sets are eroded by 16 eps, which counts where an anchor is near a boundary.
    torch.testing.assert_close(action.cpu().double(), expected, rtol=0, atol=2e-4)
    error = (score.cpu().double() - log_det).abs()
    assert error.median() < 2e-4
    assert error.quantile(0.99) < 1e-2


@pytest.mark.parametrize("impossible", [False, True])
@pytest.mark.parametrize("name", SQUASHES)
def test_no_float32_action_with_tf32_violates_anything(name: str, impossible: bool) -> None:
    batch = 20_000
    sets = [
        constraint_set.to(torch.float32, "cuda")
        for constraint_set in random_sets(batch, impossible=impossible)
    ]
    with tf32():
        region = Region.build(sets)
        bijector = SQUASHES[name](region)
        for _ in range(20):
            size = 10 ** (14 * torch.rand(batch, 1, device="cuda") - 8)
            latent = size * torch.randn(batch, DIM, device="cuda")
            assert bool(region.contains(bijector(latent)).all())


@pytest.mark.parametrize("relaxed", [False, True])
def test_hostile_actors_violate_nothing_in_an_environment(relaxed: bool) -> None:
    env = environment(1000, relaxed=relaxed).append_transform(ActionGuard())
    with tf32(), torch.no_grad():
        steps = env.rollout(30, actor_of(env, 1e3), break_when_any_done=False)
    assert all(value.is_cuda for value in steps.values(True, True))
    judged = steps["next", "cost"]
    assert float(judged.sum()) == 0 or relaxed  # relaxing one leaves the others as they are
    assert bool((steps["constraints", "limit", "relaxation"] > 0).any()) if relaxed else True


def test_a_collector_on_the_gpu() -> None:
    env = environment(64)
    collector = Collector(
        env,
        actor_of(env),
        frames_per_batch=640,
        total_frames=1280,
        auto_register_policy_transforms=False,
    )
    for batch in collector:
        assert batch["action"].is_cuda
        assert float(batch["next", "cost"].sum()) == 0
    collector.shutdown()


@pytest.mark.parametrize("moves_actor", [False, True])
def test_an_update_waits_for_nothing(moves_actor: bool) -> None:
    # An actor that stays on the CPU is trained all the same: the loss moves its parameters.
    env = environment(256, "cpu", relaxed=True)
    actor = actor_of(env)
    with torch.no_grad():
        batch = env.rollout(4, actor, break_when_any_done=False).reshape(-1).to("cuda")
    if moves_actor:
        actor.to("cuda")
    critic = ValueOperator(MLP(7, 1, num_cells=[32]), in_keys=["observation", "action"])
    loss = ConstrainedSACLoss(actor, critic, action_spec=env.action_spec_unbatched).to("cuda")
    optimizer = torch.optim.Adam(loss.parameters(), fused=True)
    update = Update(loss, optimizer, FusedSoftUpdate(loss, tau=0.005))
    for _ in range(3):
        update(batch)
    with no_synchronization():
        losses = update(batch)
    assert all(value.isfinite() for value in losses.values())


def test_a_step_waits_once_more_than_without_constraints() -> None:
    counts = []
    for env in (PointNavEnv([256], device="cuda", seed=0), environment(256)):
        for _ in range(2):
            state = env.reset()
            state["action"] = torch.zeros(256, 2, device="cuda")
            counts.append(waits(lambda: env.step(state)))  # noqa: B023 - called at once
    _, plain, _, constrained = counts
    assert constrained <= plain + 1
