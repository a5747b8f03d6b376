"""Point navigation in states where each constraint binds, and actors for it."""

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs import TransformedEnv
from torchrl.modules import ProbabilisticActor, SafeProbabilisticTensorDictSequential, TanhNormal

from cnfp_torchrl import constrain_env
from cnfp_torchrl.envs import constraint_bijectors
from cnfp_torchrl.modules import make_constrained_actor
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.training.networks import gaussian_network

ORDER = ["battery", "obstacle"]

# Position and charge: beside the rectangle, in a corner of the arena, at a station with the last
# percent, on the last way to a station, and two where little binds.
STATES = [
    ((0.31, 0.1), 100),
    ((-0.05, -0.301), 60),
    ((-0.9999, 0.9999), 80),
    ((0.93, 0.02), 21),
    ((0.0, -0.8), 22),
    ((0.62, -0.7), 29),
    ((0.6, 0.6), 100),
    ((-0.6, -0.5), 90),
]
ANCHOR = 0.0, 0.0  # of the rectangle, where the obstacle constraint cannot hold

ActorFactory = Callable[..., SafeProbabilisticTensorDictSequential]


def make_env(batch_size: tuple[int, ...] = (len(STATES),), **options: int) -> TransformedEnv:
    base = PointNavEnv(batch_size, seed=0, **options)
    return constrain_env(base, ObstacleGeometry(), BatteryGeometry(), order=ORDER)


@pytest.fixture
def env() -> TransformedEnv:
    return make_env()


@pytest.fixture
def state(env: TransformedEnv) -> TensorDictBase:
    """The states of `STATES`."""
    positions, charges = zip(*STATES, strict=True)
    return env.reset(position=positions, battery=charges)


@pytest.fixture
def network() -> nn.Module:
    return gaussian_network(5, 2, hidden=[8])


@pytest.fixture
def make_actor(env: TransformedEnv, network: nn.Module) -> ActorFactory:
    """`make_constrained_actor` for the environment; a network or options may be given."""

    def make(network: nn.Module = network, **options: object) -> ProbabilisticActor:
        stated = {"spec": env.action_spec_unbatched, "bijectors": constraint_bijectors(env)}
        return make_constrained_actor(network, **stated, **options)

    return make


@pytest.fixture
def make_tanh_actor(env: TransformedEnv, network: nn.Module) -> Callable[..., ProbabilisticActor]:
    """An ordinary TorchRL actor, not constrained."""

    def make(**options: object) -> ProbabilisticActor:
        defaults = {
            "in_keys": ["loc", "scale"],
            "spec": env.action_spec_unbatched,
            "distribution_class": TanhNormal,
        }
        body = TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"])
        return ProbabilisticActor(body, **{**defaults, **options})

    return make


@pytest.fixture
def inside() -> Callable[[TensorDictBase], dict[str, Tensor]]:
    """Whether actions are in each published set: plain inequalities in float64, no set class."""

    def check(tensordict: TensorDictBase) -> dict[str, Tensor]:
        action = tensordict["action"].double()
        battery, obstacle = (tensordict["constraints", name].double() for name in ORDER)
        distance = torch.linalg.vector_norm(action - battery["center"], dim=-1)
        in_box = (action >= obstacle["low"]) & (action <= obstacle["high"])
        return {
            "bounds": (action.abs() <= 1).all(-1),
            "battery": distance <= battery["radius"],
            "obstacle": in_box.all(-1),
        }

    return check
