"""Transitions of point navigation, and what a loss needs to learn from them."""

from collections.abc import Callable
from typing import Any

import pytest
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv
from torchrl.modules import ValueOperator

from cnfp_torchrl import constrain_env
from cnfp_torchrl.modules import make_constrained_actor
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.training.networks import action_value_network, gaussian_network
from tests.training.conftest import tiny_run

__all__ = ["tiny_run"]

MakeActor = Callable[..., Any]


@pytest.fixture
def env() -> TransformedEnv:
    geometries = ObstacleGeometry(), BatteryGeometry()
    return constrain_env(PointNavEnv((64,), seed=0), *geometries, order=["battery", "obstacle"])


@pytest.fixture
def make_actor(env: TransformedEnv) -> MakeActor:
    def make(**options: Any) -> Any:
        return make_constrained_actor(gaussian_network(5, 2, hidden=[8]), env, **options)

    return make


@pytest.fixture
def critic() -> ValueOperator:
    return action_value_network(5, 2, hidden=[8])


@pytest.fixture
def transitions(env: TransformedEnv, make_actor: MakeActor) -> TensorDictBase:
    """256 transitions, of which some constraints bind."""
    return env.rollout(4, make_actor(), break_when_any_done=False).detach().reshape(-1)
