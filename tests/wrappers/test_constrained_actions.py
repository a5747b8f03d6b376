"""Gymnasium environments whose every action is allowed, whoever acts."""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from tensordict import TensorDictBase

from cnfp_torchrl.envs import GeometryTransform
from cnfp_torchrl.geometry import Ball, Box, WeightedL1Ball
from cnfp_torchrl.tasks.point_nav import (
    POINT_NAV_ID,
    BatteryGeometry,
    ObstacleGeometry,
    PointNavGymnasiumEnv,
)
from cnfp_torchrl.wrappers import ConstrainedActions, VectorConstrainedActions

LIMIT = 4.0


class PowerLimit(GeometryTransform):
    """Pendulum's motor draws at most so much power."""

    def constraint_set(self, tensordict: TensorDictBase) -> WeightedL1Ball:
        speed = tensordict["observation"][..., 2:]
        return WeightedL1Ball(speed, speed.new_tensor(LIMIT), validate_args=False)


def draws_too_much(before: TensorDictBase, after: TensorDictBase) -> torch.Tensor:
    torque, speed = before["action"].double(), before["observation"][..., 2:].double()
    return ((torque * speed).abs() > LIMIT).squeeze(-1)


def point_nav(**options: Any) -> ConstrainedActions:
    env = gymnasium.make(POINT_NAV_ID)
    return ConstrainedActions(env, BatteryGeometry(), ObstacleGeometry(), **options)


def vector(mode: AutoresetMode = AutoresetMode.NEXT_STEP, **options: Any) -> Any:
    envs = SyncVectorEnv([lambda: gymnasium.make(POINT_NAV_ID)] * 4, autoreset_mode=mode)
    return VectorConstrainedActions(envs, BatteryGeometry(), ObstacleGeometry(), **options)


AGENTS: dict[str, Callable[[ConstrainedActions], np.ndarray]] = {
    "random": lambda env: env.action_space.sample(),
    "saturated": lambda env: np.sign(env.action_space.sample()),
    "beyond its space": lambda env: 1e6 * env.action_space.sample(),
}


@pytest.mark.parametrize("agent", AGENTS)
@pytest.mark.parametrize("unbounded", [False, True])
def test_every_agent_is_safe(agent: str, unbounded: bool) -> None:
    env = point_nav(unbounded=unbounded)
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(110):
        _, _, terminated, truncated, info = env.step(AGENTS[agent](env).astype(np.float32))
        assert not info["cost"].any()
        if terminated or truncated:
            env.reset()


def test_it_is_an_environment_of_gymnasium() -> None:
    env = ConstrainedActions(PointNavGymnasiumEnv(), BatteryGeometry(), ObstacleGeometry())
    with pytest.warns(UserWarning, match="different from the unwrapped version"):
        check_env(env, skip_render_check=True)


def test_free_actions_are_stretched_onto_the_bounds_where_nothing_binds() -> None:
    env = ConstrainedActions(gymnasium.make("Pendulum-v1"), PowerLimit("power"))
    assert env.action_space == spaces.Box(-1.0, 1.0, (1,))
    for free in (-1.0, -0.3, 0.0, 0.7, 1.0):
        env.reset(seed=0)
        env.unwrapped.state = np.array([0.0, 0.0])
        *_, info = env.step(np.array([0.0], np.float32))  # a state without speed
        assert info["constraints"]["power"]["weights"] == 0
        *_, info = env.step(np.array([free], np.float32))
        np.testing.assert_allclose(info["executed_action"], [2 * free], rtol=1e-5, atol=1e-6)


def test_info_shows_the_geometry_of_the_state_it_comes_with() -> None:
    env = point_nav()
    observation, info = env.reset(seed=3)
    for _ in range(30):
        shown = info["constraints"]
        assert set(shown) == {"battery", "obstacle", "anchor"}
        assert shown["battery"]["active"].item() is True
        assert shown["battery"]["relaxation"] == 0
        ball = Ball(*(torch.tensor(shown["battery"][f]) for f in ("center", "radius")))
        box = Box(*(torch.tensor(shown["obstacle"][f]) for f in ("low", "high")))
        expected = BatteryGeometry().constraint_set({"observation": torch.tensor(observation)})
        np.testing.assert_array_equal(shown["battery"]["center"], expected.center)
        kept = {name: value.copy() for name, value in shown["battery"].items()}
        observation, *_, info = env.step(env.action_space.sample())
        executed = torch.tensor(info["executed_action"])
        assert ball.contains(executed)
        assert box.contains(executed)
        # What the agent keeps of an info does not change under its hands.
        for name, value in kept.items():
            np.testing.assert_array_equal(shown["battery"][name], value)


@pytest.mark.parametrize("mode", AutoresetMode)
def test_vector_environments(mode: AutoresetMode) -> None:
    env = vector(mode)
    assert env.action_space.shape == (4, 2)
    env.action_space.seed(0)
    _, info = env.reset(seed=0)
    assert info["constraints"]["battery"]["center"].shape == (4, 2)
    over = 0
    for _ in range(210):
        _, _, terminated, truncated, info = env.step(env.action_space.sample())
        assert not info["cost"].any()
        assert info["executed_action"].shape == (4, 2)
        assert info["_executed_action"].all()
        done = terminated | truncated
        over += done.sum()
        if mode == AutoresetMode.DISABLED and done.any():
            env.reset(options={"reset_mask": done})
    assert over == 8


def test_vector_and_single_environments_execute_the_same() -> None:
    single, several = point_nav(), vector()
    single.reset(seed=0)
    several.reset(seed=[0, 1, 2, 3])
    for free in np.random.default_rng(0).uniform(-1, 1, (20, 4, 2)).astype(np.float32):
        *_, one = single.step(free[0])
        *_, four = several.step(free)
        np.testing.assert_allclose(four["executed_action"][0], one["executed_action"], atol=1e-6)


def test_indicators_count_where_the_environment_does_not() -> None:
    judges = {"power": draws_too_much, "never": lambda before, after: before["action"][..., 0] > 9}
    env = ConstrainedActions(gymnasium.make("Pendulum-v1"), PowerLimit("power"), indicators=judges)
    _, info = env.reset(seed=0)
    np.testing.assert_array_equal(info["cost"], np.zeros(2, np.float32))
    for _ in range(100):
        *_, info = env.step(np.ones(1, np.float32))
        np.testing.assert_array_equal(info["cost"], np.zeros(2, np.float32))
    judges = {"always": lambda before, after: after["observation"][..., 0] < 9}
    envs = SyncVectorEnv([lambda: gymnasium.make("Pendulum-v1", max_episode_steps=3)] * 2)
    env = VectorConstrainedActions(envs, PowerLimit("power"), indicators=judges)
    env.reset(seed=0)
    costs = [env.step(np.ones((2, 1), np.float32))[-1]["cost"][:, 0].tolist() for _ in range(5)]
    # The fourth step resets both, and executes nothing.
    assert costs == [[1, 1], [1, 1], [1, 1], [0, 0], [1, 1]]


class Camera(gymnasium.Env):
    """Observations in a dictionary, in float64 and in bytes."""

    observation_space = spaces.Dict(
        {
            "speed": spaces.Box(-1, 1, (2,), np.float64),
            "image": spaces.Box(0, 255, (3, 3), np.uint8),
        }
    )
    action_space = spaces.Box(-3.0, 5.0, (2,), np.float64)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict]:
        assert action.dtype == np.float64
        return self.observation_space.sample(), 0.0, False, False, {}


class Slow(GeometryTransform):
    """A ball around minus the speed."""

    def constraint_set(self, tensordict: TensorDictBase) -> Ball:
        speed = tensordict["speed"]
        return Ball(-speed, torch.ones_like(speed[..., 0]), validate_args=False)


def test_dictionaries_and_float64() -> None:
    env = ConstrainedActions(Camera(), Slow("slow", in_keys=["speed"]))
    assert env.action_space.dtype == np.float64
    observation, _ = env.reset(seed=0)
    for _ in range(50):
        speed = observation["speed"]
        observation, *_, info = env.step(np.sign(env.action_space.sample()))
        assert np.linalg.norm(info["executed_action"] + speed) <= 1


def test_refusals() -> None:
    env = gymnasium.make(POINT_NAV_ID)
    with pytest.raises(ValueError, match="geometries: expected at least one"):
        ConstrainedActions(env)
    with pytest.raises(TypeError, match="given the class BatteryGeometry"):
        ConstrainedActions(env, BatteryGeometry)
    with pytest.raises(ValueError, match=r"flow: expected one that guarantees.*SquashFlow"):
        ConstrainedActions(env, BatteryGeometry(), flow="squash")
    with pytest.raises(ValueError, match="order: expected each of the constraints"):
        point_nav(order=["battery"])
    with pytest.raises(TypeError, match="action_space: expected a Box"):
        ConstrainedActions(gymnasium.make("CartPole-v1"), BatteryGeometry())
    with pytest.raises(TypeError, match="VectorConstrainedActions"):
        ConstrainedActions(vector(), BatteryGeometry())
    with pytest.raises(ValueError, match="SAME_STEP"):
        vector(AutoresetMode.SAME_STEP, indicators={"a": draws_too_much})
    env = ConstrainedActions(PointNavGymnasiumEnv(), BatteryGeometry())
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2, np.float32))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action at index \[1\]: expected a finite number"):
        env.step(np.array([0, np.nan], np.float32))
    with pytest.raises(ValueError, match=r"action: expected shape \(2,\), given \(1, 2\)"):
        env.step(np.zeros((1, 2), np.float32))
