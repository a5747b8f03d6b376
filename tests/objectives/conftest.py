"""Point navigation, and transitions that a loss learns from."""

import pytest
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from tests.point_nav import make_actor, make_env
from tests.training.conftest import tiny_run

__all__ = ["tiny_run"]


@pytest.fixture
def env() -> TransformedEnv:
    return make_env((64,))


@pytest.fixture
def transitions(env: TransformedEnv) -> TensorDictBase:
    """256 transitions, of which some constraints bind."""
    return env.rollout(4, make_actor(), break_when_any_done=False).detach().reshape(-1)
