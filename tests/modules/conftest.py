"""Point navigation, and the states of `STATES`."""

import pytest
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from tests.point_nav import STATES, make_env


@pytest.fixture
def env() -> TransformedEnv:
    return make_env()


@pytest.fixture
def state(env: TransformedEnv) -> TensorDictBase:
    positions, charges = zip(*STATES, strict=True)
    return env.reset(position=positions, battery=charges)
