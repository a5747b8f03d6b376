"""Environments that render themselves are pictured, and no others are asked."""

import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from torchrl.envs import EnvBase, GymWrapper, RewardSum, SerialEnv, TransformedEnv

from cnfp_torchrl.envs import can_render
from cnfp_torchrl.envs.camera import Camera
from cnfp_torchrl.tasks.point_nav import PointNavEnv


class Blind(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1, 1, (2,))
    action_space = gymnasium.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return np.zeros(2, np.float32), 0.0, False, False, {}


class Seeing(Blind):
    metadata = {"render_modes": ["human", "rgb_array"]}  # noqa: RUF012

    def render(self) -> Any:
        return np.full((4, 6, 3), 7) if self.render_mode == "rgb_array" else None


class Failing(Blind):
    def render(self) -> Any:
        raise RuntimeError("no display")


def wrapped(kind: type[gymnasium.Env]) -> EnvBase:
    return TransformedEnv(
        SerialEnv(2, lambda: GymWrapper(gymnasium.wrappers.TimeLimit(kind(), 5))), RewardSum()
    )


@pytest.fixture(params=[Blind, Seeing, Failing])
def kind(request: pytest.FixtureRequest) -> type[gymnasium.Env]:
    return request.param


def test_who_renders_is_known_without_asking(kind: type[gymnasium.Env]) -> None:
    env = wrapped(kind)
    env.reset()
    assert can_render(env) == (kind is not Blind)
    assert not can_render(PointNavEnv())
    assert not can_render(None)


def test_a_picture_is_taken_without_a_render_mode() -> None:
    env = wrapped(Seeing)
    env.reset()
    picture = Camera(env).picture()
    assert picture is not None
    assert picture.shape == (4, 6, 3)
    assert bool((picture == 7).all())


def test_who_cannot_is_never_asked() -> None:
    env = wrapped(Blind)
    env.reset()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert Camera(env).picture() is None


def test_who_fails_is_told_of_once() -> None:
    env = wrapped(Failing)
    env.reset()
    camera = Camera(env)
    with pytest.warns(UserWarning, match="Failing cannot render: no display"):
        assert camera.picture() is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert camera.picture() is None
