"""Point navigation in states where each constraint binds, and actors for it."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.envs import CatTensors, TransformedEnv
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator

from cnfp_torchrl import Ball, Box, constrain_env
from cnfp_torchrl.envs import PreviousAction
from cnfp_torchrl.modules import ConstraintBijector, make_constrained_actor
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.tasks.robots import RateLimit
from cnfp_torchrl.training.networks import action_value_network, gaussian_network

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
SPEC = Bounded(-1.0, 1.0, (2,))
BIJECTORS = [ConstraintBijector("battery", Ball), ConstraintBijector("obstacle", Box)]


def make_env(batch_size: tuple[int, ...] = (len(STATES),), **options: int) -> TransformedEnv:
    base = PointNavEnv(batch_size, seed=0, **options)
    return constrain_env(base, ObstacleGeometry(), BatteryGeometry(), order=ORDER)


def make_rate_limited_env(batch_size: tuple[int, ...]) -> TransformedEnv:
    """Return one whose network observes the previous action as the end of a vector of seven."""
    env = TransformedEnv(PointNavEnv(batch_size, seed=0), PreviousAction())
    parts = ["observation", "previous_action"]
    env.append_transform(CatTensors(parts, "observation", del_keys=False, sort=False))
    return constrain_env(env, RateLimit("rate", [0.2, 0.2]))


@contextmanager
def same_weights() -> Iterator[None]:
    """Give networks that are made in this context the same weights each time."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


@same_weights()
def make_network() -> nn.Module:
    return gaussian_network(5, 2, hidden=[8])


@same_weights()
def make_critic() -> ValueOperator:
    return action_value_network(5, 2, hidden=[8])


def make_actor(network: nn.Module | None = None, **options: Any) -> Any:
    """Return a constrained actor for the environment."""
    network = make_network() if network is None else network
    return make_constrained_actor(network, spec=SPEC, bijectors=BIJECTORS, **options)


def make_tanh_actor(network: nn.Module | None = None, **options: Any) -> ProbabilisticActor:
    """Return an ordinary TorchRL actor, not constrained."""
    network = make_network() if network is None else network
    defaults = {"in_keys": ["loc", "scale"], "spec": SPEC, "distribution_class": TanhNormal}
    body = TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"])
    return ProbabilisticActor(body, **{**defaults, **options})


def inside(tensordict: TensorDictBase) -> dict[str, Tensor]:
    """Tell whether actions are in each published set: inequalities in float64, no set class."""
    action = tensordict["action"].double()
    battery, obstacle = (tensordict["constraints", name].double() for name in ORDER)
    distance = torch.linalg.vector_norm(action - battery["center"], dim=-1)
    in_box = (action >= obstacle["low"]) & (action <= obstacle["high"])
    return {
        "bounds": (action.abs() <= 1).all(-1),
        "battery": distance <= battery["radius"],
        "obstacle": in_box.all(-1),
    }
