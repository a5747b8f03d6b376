"""Exploration and repeated actions of TorchRL, which know no constraints, are refused."""

from collections.abc import Callable

import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Bounded
from torchrl.envs import FrameSkipTransform, MultiAction, NoopResetEnv, Transform, TransformedEnv
from torchrl.modules import (
    AdditiveGaussianModule,
    EGreedyModule,
    OrnsteinUhlenbeckProcessModule,
    TanhNormal,
)

from cnfp_torchrl.envs import ActionGuard, constrain_env
from cnfp_torchrl.modules import (
    FlowMap,
    constrain,
    flow_head,
    guarded,
    refuse_exploration,
    split_at_latent,
)
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from tests.point_nav import make_actor, make_tanh_actor

SPEC = Bounded(-1.0, 1.0, (2,))
NOISES = [
    lambda **options: AdditiveGaussianModule(SPEC, **options),
    lambda **options: OrnsteinUhlenbeckProcessModule(SPEC, **options),
    lambda **options: EGreedyModule(SPEC, **options),
]


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize(
    "use",
    [refuse_exploration, guarded, flow_head, split_at_latent, lambda p: constrain(p, flow="gauge")],
)
def test_noise_on_constrained_actions(
    noise: Callable[..., nn.Module], use: Callable[..., object]
) -> None:
    module = noise()
    policy = TensorDictSequential(make_actor(), module)
    with pytest.raises(TypeError, match=f"no {type(module).__name__} on constrained actions"):
        use(policy)


@pytest.mark.parametrize("noise", NOISES)
def test_noise_on_the_latent_may_stay(noise: Callable[..., nn.Module]) -> None:
    latent = TensorDictModule(nn.Linear(5, 2), ["observation"], ["latent"])
    flow = FlowMap(flow_head(make_actor()))
    refuse_exploration(TensorDictSequential(latent, noise(action_key="latent"), flow))


@pytest.mark.parametrize(
    "several",
    [FrameSkipTransform(4), MultiAction(), NoopResetEnv(noops=3)],
    ids=lambda t: type(t).__name__,
)
@pytest.mark.parametrize("guard", [False, True])
def test_steps_that_nobody_saw(several: Transform, guard: bool) -> None:
    env = constrain_env(PointNavEnv([]), BatteryGeometry(), ObstacleGeometry())
    if guard:
        env.append_transform(ActionGuard())
    env.append_transform(several.clone())
    with pytest.raises(ValueError, match=f"{type(several).__name__}: expected inside"):
        env.reset()


def test_repeated_actions_inside_the_constrained_environment_may_stay() -> None:
    inner = TransformedEnv(PointNavEnv([]), FrameSkipTransform(2))
    constrain_env(inner, BatteryGeometry(), ObstacleGeometry()).reset()


def test_a_guard_knows_the_bounds_of_its_environment(env: TransformedEnv) -> None:
    guarded(make_actor(), env)
    half = {"spec": Bounded(-0.5, 0.5, (2,)), "distribution_kwargs": {"low": -0.5, "high": 0.5}}
    narrow = make_tanh_actor(**half, distribution_class=TanhNormal)
    actor = constrain(narrow, bijectors=flow_head(make_actor()).bijectors)
    with pytest.raises(ValueError, match=r"actor: expected the environment's action bounds"):
        guarded(actor, env)
    assert torch.equal(flow_head(actor).bounds.high, torch.full((2,), 0.5))
