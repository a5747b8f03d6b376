"""A policy of point navigation, to be deployed."""

from typing import Any

import pytest
import torch
from torchrl.envs import TransformedEnv

from cnfp_torchrl import constrain_env, make_constrained_actor
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.training.networks import gaussian_network


def point_nav(batch: int = 64) -> TransformedEnv:
    env = PointNavEnv([batch], seed=0)
    return constrain_env(env, BatteryGeometry(), ObstacleGeometry())


def actor_for(env: TransformedEnv, size: int = 5, dim: int = 2, **options: Any) -> Any:
    torch.manual_seed(0)
    return make_constrained_actor(gaussian_network(size, dim, hidden=[16]), env, **options)


@pytest.fixture
def env() -> TransformedEnv:
    return point_nav()
