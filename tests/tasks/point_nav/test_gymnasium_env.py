"""The Gymnasium environment: its checker, TorchRL's wrapper, the dynamics, pictures."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from torchrl.envs import Compose, GymEnv, TransformedEnv, check_env_specs

from cnfp_torchrl.envs import ConstraintCost, constraint_names
from cnfp_torchrl.tasks.point_nav import (
    POINT_NAV_ID,
    BatteryGeometry,
    Layout,
    ObstacleGeometry,
    PointNavEnv,
    render_point_nav,
)
from tests.layouts import NONE, THREE


@pytest.mark.parametrize("layout", [None, NONE, THREE])
def test_gymnasium_checker(layout: Layout | None) -> None:
    check_env(gymnasium.make(POINT_NAV_ID, layout=layout, render_mode="rgb_array").unwrapped)


def test_torchrl_reads_it_with_its_costs() -> None:
    check_env_specs(GymEnv(POINT_NAV_ID))
    env = TransformedEnv(
        GymEnv(POINT_NAV_ID).auto_register_info_dict(),
        Compose(ObstacleGeometry(), BatteryGeometry(), ConstraintCost()),
    )
    check_env_specs(env)
    rollout = env.rollout(250, break_when_any_done=False)
    assert rollout["next", "truncated"].flatten().nonzero().flatten().tolist() == [99, 199]
    cost = rollout["next", "cost"]
    assert cost.dtype == torch.float32
    assert cost.shape == (250, 2)
    assert torch.equal(rollout["next", "episode_cost"][99], cost[:100].sum(0))
    assert constraint_names(env) == constraint_names(env.base_env) == ("obstacle", "battery")


@pytest.mark.parametrize("collision", ["pass", "block"])
def test_it_steps_like_the_torchrl_environment(collision: str) -> None:
    gym_env = gymnasium.make(POINT_NAV_ID, collision=collision)
    observation, info = gym_env.reset(seed=4)
    assert info["cost"].tolist() == [0.0, 0.0]
    for _ in range(100):
        env = PointNavEnv(collision=collision)
        state = env.reset(
            position=observation[:2],
            battery=round(float(observation[2]) * 100),
            goal=observation[3:],
        )
        action = gym_env.action_space.sample()
        after = env.step(state.set("action", torch.from_numpy(action)))["next"]
        observation, reward, terminated, truncated, info = gym_env.step(action)
        assert observation[:3].tolist() == after["observation"][:3].tolist()
        assert reward == float(after["reward"])
        assert info["cost"].dtype == np.float32
        assert info["cost"].tolist() == after["cost"].tolist()
        assert not terminated
    assert truncated


def test_seeds_and_chosen_states() -> None:
    env = gymnasium.make(POINT_NAV_ID)
    first = env.reset(seed=1)[0]
    second = env.reset()[0]
    assert not np.array_equal(first, second)
    assert np.array_equal(env.reset(seed=1)[0], first)
    assert np.array_equal(env.reset()[0], second)
    options = {"position": [0.5, 0.25], "battery": 33}
    chosen = env.reset(seed=2, options=options)[0]
    assert chosen[:3].tolist() == [0.5, 0.25, np.float32(0.33)]


def test_a_vector_of_them() -> None:
    envs = gymnasium.make_vec(POINT_NAV_ID, num_envs=3, vectorization_mode="sync")
    envs.reset(seed=0)
    info = envs.step(envs.action_space.sample())[-1]
    assert np.stack(info["cost"]).shape == (3, 2)


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match="collision: expected one of"):
        gymnasium.make(POINT_NAV_ID, collision="bounce")
    env = gymnasium.make(POINT_NAV_ID).unwrapped
    with pytest.raises(ValueError, match="render_mode: expected None or one of"):
        type(env)(render_mode="human")  # type: ignore[call-arg]
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2, np.float32))
    with pytest.raises(ValueError, match="options: expected a dict with any of"):
        env.reset(options={"charge": 3})
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action: expected two numbers"):
        env.step(np.array([0.0, np.nan], np.float32))
    assert env.render() is None


def test_pictures_show_what_there_is() -> None:
    env = gymnasium.make(POINT_NAV_ID, render_mode="rgb_array")
    env.reset(seed=0, options={"position": [0.5, 0.5], "goal": [-0.6, 0.6], "battery": 40})
    picture = env.render()
    assert picture.shape == (512, 512, 3)
    assert picture.dtype == np.uint8
    scale, middle = 216, (256, 232)

    def color(x: float, y: float) -> tuple[int, ...]:
        return tuple(picture[round(middle[1] - scale * y), round(middle[0] + scale * x)])

    assert color(0.0, 0.0) == (0x5A, 0x5A, 0x5A)  # the rectangle
    assert color(0.5, 0.5) == (0x00, 0x72, 0xB2)  # the agent
    assert color(-0.6, 0.6) == (0xE6, 0x9F, 0x00)  # the goal
    assert color(0.95, 0.0) == (0x00, 0x9E, 0x73)  # a station
    assert color(-0.6, -0.6) == (0xFF, 0xFF, 0xFF)  # the floor
    small = render_point_nav(THREE, position=(0, 0), battery=5, goal=(0.9, 0.9), size=128)
    assert small.shape == (128, 128, 3)
