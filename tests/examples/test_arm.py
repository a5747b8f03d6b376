"""The arm keeps its limits whatever drives it, by kinematics of this file's own."""

import re
from collections.abc import Callable

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor

from cnfp_torchrl.envs import constrain_env, constraint_bijectors
from cnfp_torchrl.modules import ConstrainedFlowModule
from tests.examples.conftest import Optimized
from tests.examples.scripts import load, run

Run = Callable[..., str]


def counts(printed: str) -> list[int]:
    return [int(count) for count in re.findall(r": (\d+) violations in 256 steps", printed)]


def test_learns_within_both_limits(optimized: Optimized) -> None:
    assert counts(run("arm", "--steps", 256)) == [0, 0]
    optimized.assert_all_learned()


def test_without_the_limits_it_breaks_them() -> None:
    speed, _ = counts(run("arm", "--steps", 256, "--unsafe"))
    assert speed > 50


def end_points(angles: np.ndarray) -> np.ndarray:
    first, second, third = np.moveaxis(angles, -1, 0)
    bent, tip = first + second, first + second + third
    return np.stack(
        [
            0.4 * np.cos(first) + 0.4 * np.cos(bent) + 0.2 * np.cos(tip),
            0.4 * np.sin(first) + 0.4 * np.sin(bent) + 0.2 * np.sin(tip),
        ],
        axis=-1,
    )


@pytest.mark.parametrize("size", [1.0, 1e6])
def test_no_drive_gets_the_end_point_to_the_wall_or_beyond_its_speed(size: float) -> None:
    script = load("arm")
    arm = script.Arm(64)
    env = constrain_env(arm, script.Speed("speed"), script.Wall("wall"))

    def at_the_wall(observation: Tensor) -> tuple[Tensor, Tensor]:
        pull = -script.LINKS * observation[..., 3:]
        forward = pull.flip(-1).cumsum(-1).flip(-1).sign()
        return size * forward, size * torch.full_like(forward, 0.5)

    head = ConstrainedFlowModule(env.action_spec_unbatched, constraint_bijectors(env))
    drive = TensorDictModule(at_the_wall, in_keys=["observation"], out_keys=["loc", "scale"])
    env.set_seed(0)
    state = env.reset()
    actor = TensorDictSequential(drive, head)
    nearest, fastest = -np.inf, 0.0
    with torch.no_grad():
        for _ in range(150):
            state = actor(state)
            before, velocity = arm.angles, state["action"].double().numpy()
            state = env.step(state)["next"].exclude("reward")
            between = before + np.linspace(0, 1, 11)[:, None, None] * (arm.angles - before)
            nearest = max(nearest, end_points(between)[..., 0].max())
            # The speed at the beginning of the step, by a difference of 1e-6 s either way.
            ends = end_points(before + 1e-6 * velocity) - end_points(before - 1e-6 * velocity)
            fastest = max(fastest, np.linalg.norm(ends / 2e-6, axis=-1).max())
            assert not state["cost"].any()
    assert 0.69 < nearest <= 0.7
    assert 0.45 < fastest <= 0.5
