"""HalfCheetah whose motors change slowly and draw little: limits of rate and power together.

    python experiments/examples/half_cheetah_limits.py [--steps 2000]

Needs MuJoCo, `pip install "gymnasium[mujoco]"`. Robots, limits and judges come with the library,
actor and training are those of `sac_made_safe.py`. The limit of power is the last, so it has
priority: where a fast joint leaves no action that keeps both, the rate gives way, by the least
amount, and the state says so.
"""

import argparse

import torch
from sac_made_safe import make_actor, train

from cnfp_torchrl import constrain, constrain_env
from cnfp_torchrl.tasks.robots import (
    PowerJudge,
    PowerLimit,
    RateJudge,
    RateLimit,
    robot_with_previous_action,
)

RATES, POWER = (0.2, 0.2, 0.2, 0.5, 0.5, 0.5), 20.0


def main() -> None:
    """Train, and print what the judges counted on the simulator's own state."""
    parser = argparse.ArgumentParser(description="HalfCheetah with two limits, by SAC.")
    parser.add_argument("--steps", type=int, default=2000, help="environment steps")
    arguments = parser.parse_args()
    torch.manual_seed(0)
    judges = {"rate": RateJudge(RATES), "power": PowerJudge(POWER)}
    # The previous action is part of the state: the limit reads it, and so does the actor.
    cheetah = robot_with_previous_action("HalfCheetah-v5", [4], judges=judges)
    env = constrain_env(cheetah, RateLimit("rate", RATES), PowerLimit("power", POWER, joints=6))
    actor = constrain(make_actor(env), env)
    steps = train(env, actor, steps=arguments.steps, updates=8)
    for name, broken in zip(judges, steps["next", "cost"].bool().unbind(-1), strict=True):
        active = steps["constraints", name, "active"].reshape(broken.shape)
        print(
            f"{name}: {int((broken & active).sum())} violations in {len(steps)} steps, "
            f"and gave way in {int((~active).sum())} others"
        )


if __name__ == "__main__":
    main()
