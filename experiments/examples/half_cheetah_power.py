"""HalfCheetah whose joints draw at most 20 units of power, sum |velocity_i action_i| <= 20.

    python experiments/examples/half_cheetah_power.py [--steps 2000]

Needs MuJoCo, `pip install "gymnasium[mujoco]"`. Actor and training are those of `sac_made_safe.py`,
which know nothing of the limit.
"""

import argparse

import torch
from sac_made_safe import make_actor, train
from tensordict import TensorDictBase
from torchrl.envs import DoubleToFloat, GymEnv, TransformedEnv

from cnfp_torchrl import GeometryTransform, WeightedL1Ball, constrain, constrain_env


class PowerLimit(GeometryTransform):
    """The last six numbers of the observation are the velocities of the actuated joints."""

    def constraint_set(self, tensordict: TensorDictBase) -> WeightedL1Ball:
        """Return the actions that draw no more than the limit."""
        return WeightedL1Ball(tensordict["observation"][..., 11:], torch.tensor(20.0))


def main() -> None:
    """Train, and report the power that was drawn."""
    parser = argparse.ArgumentParser(description="HalfCheetah with a limited power, by SAC.")
    parser.add_argument("--steps", type=int, default=2000, help="environment steps")
    arguments = parser.parse_args()
    cheetah = TransformedEnv(GymEnv("HalfCheetah-v5"), DoubleToFloat())
    env = constrain_env(cheetah, PowerLimit("power"))
    actor = constrain(make_actor(env), env)
    steps = train(env, actor, steps=arguments.steps, updates=8)
    power = (steps["observation"][..., 11:].double() * steps["action"].double()).abs().sum(-1)
    print(f"power: mean {power.mean():.2f}, largest {power.max():.6f}, limit 20")


if __name__ == "__main__":
    main()
