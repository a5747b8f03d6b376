"""Policies to deploy: one of point navigation, and one of every family of sets."""

from typing import Any

import pytest
import torch
from gymnasium import spaces
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from cnfp_torchrl import constrain_env, make_constrained_actor
from cnfp_torchrl.deploy import DeployedPolicy
from cnfp_torchrl.envs import GeometryTransform
from cnfp_torchrl.geometry import ConstraintSet
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.training.networks import gaussian_network
from cnfp_torchrl.wrappers.observed_env import ObservedEnv
from tests.geometry.cases import FAMILIES


def point_nav(batch: int = 64) -> TransformedEnv:
    env = PointNavEnv([batch], seed=0)
    return constrain_env(env, BatteryGeometry(), ObstacleGeometry())


def actor_for(env: TransformedEnv, size: int = 5, dim: int = 2, **options: Any) -> Any:
    torch.manual_seed(0)
    return make_constrained_actor(gaussian_network(size, dim, hidden=[16]), env, **options)


@pytest.fixture
def env() -> TransformedEnv:
    return point_nav()


FAR = 1e8


class Shown(GeometryTransform):
    """The sets whose fields are the observation."""

    def __init__(self, family: type[ConstraintSet]) -> None:
        super().__init__("shown", in_keys=list(family.event_dims))
        self.family = family

    def constraint_set(self, tensordict: TensorDictBase) -> ConstraintSet:
        fields = {name: tensordict[name] for name in self.family.event_dims}
        # Observations are finite; what is not, in a set, is shown as a number beyond all others.
        fields = {
            name: torch.where(value.abs() >= FAR, value.sign() * torch.inf, value)
            for name, value in fields.items()
        }
        return self.family(**fields, validate_args=False)


def of_family(
    name: str, dim: int, count: int, **options: Any
) -> tuple[DeployedPolicy, tuple[Tensor, ...]]:
    """Return a policy whose constraint is a set of a family, and inputs of random sets of it."""
    torch.manual_seed(0)
    sets, _ = FAMILIES[name][0]((count,), dim)
    sets = sets.with_fields(
        lambda field, dims: field.float().expand(count, *field.shape[field.ndim - dims :])
    )
    fields = {key: value.clamp(-FAR, FAR) for key, value in sets.fields().items()}
    large = {key: spaces.Box(-1e9, 1e9, value.shape[1:]) for key, value in fields.items()}
    space = spaces.Dict({**large, "observation": spaces.Box(-9, 9, (3,))})
    observed = ObservedEnv(space, spaces.Box(-4, 4, (dim,)))
    # The zeros of a spec need not be a set; the first one is.
    observed.show(
        {key: value[0].numpy() for key, value in fields.items()} | {"observation": [0.0] * 3}
    )
    env = constrain_env(observed, Shown(type(sets)))
    policy = DeployedPolicy(actor_for(env, 3, dim), env, **options)
    inputs = {**fields, "observation": 3 * torch.randn(count, 3)}
    return policy, tuple(inputs[key] for key in policy.input_keys)
