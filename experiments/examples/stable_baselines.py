"""Stable-Baselines3, made safe by one line around the environment.

    python experiments/examples/stable_baselines.py [--algorithm ppo|sac] [--steps 20000] [--unsafe]

The agent is Stable-Baselines3's own and knows no constraints. Violations are counted by the
environment, on every executed action of the training.
"""

import argparse
from typing import Any

import gymnasium
import stable_baselines3
import torch
from stable_baselines3.common.callbacks import BaseCallback

from cnfp_torchrl.tasks.point_nav import POINT_NAV_ID, BatteryGeometry, ObstacleGeometry
from cnfp_torchrl.wrappers import ConstrainedActions

OPTIONS: dict[str, dict[str, Any]] = {
    "ppo": {"n_steps": 256, "batch_size": 64},
    "sac": {"learning_starts": 100, "batch_size": 64},
}


def main() -> None:
    """Train on point navigation and count violations."""
    parser = argparse.ArgumentParser(description="Stable-Baselines3 with hard constraints.")
    parser.add_argument("--algorithm", choices=sorted(OPTIONS), default="ppo")
    parser.add_argument("--steps", type=int, default=20000, help="environment steps")
    parser.add_argument("--unsafe", action="store_true", help="leave the constraints out")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)

    env: Any = gymnasium.make(POINT_NAV_ID)
    if not arguments.unsafe:
        # The last constraint has the highest priority.
        env = ConstrainedActions(env, BatteryGeometry(), ObstacleGeometry())
    algorithm = getattr(stable_baselines3, arguments.algorithm.upper())
    options = {**OPTIONS[arguments.algorithm], "seed": arguments.seed, "device": "cpu"}
    model = algorithm("MlpPolicy", env, **options)
    count = CountViolations()
    model.learn(arguments.steps, callback=count)
    print(f"mean reward in the last quarter {count.mean_reward():.2f}")
    for name, violations in zip(env.metadata["constraint_names"], count.total, strict=True):
        print(f"{name}: {violations:.0f} violations in {count.num_timesteps} steps")


class CountViolations(BaseCallback):
    """Sums what the environment says of every executed action."""

    def _on_training_start(self) -> None:
        self.total: Any = 0
        self.rewards: list[float] = []

    def _on_step(self) -> bool:
        self.total = self.total + sum(info["cost"] for info in self.locals["infos"])
        self.rewards += self.locals["rewards"].tolist()
        return True

    def mean_reward(self) -> float:
        """Return the mean reward of the last quarter of the training."""
        last = self.rewards[-len(self.rewards) // 4 :]
        return sum(last) / len(last)


if __name__ == "__main__":
    main()
