"""A constrained actor in TorchRL's own trainer, assembled from its groups of configurations.

    python experiments/examples/torchrl_trainer.py [--steps 4000] [--seed 0] [OVERRIDE ...]

The configuration is `torchrl_trainer.yaml`; overrides are Hydra's, such as ``loss.entropy=action``.
The guard in it would end the training at the first action outside of a set.
"""

import argparse
from pathlib import Path
from typing import Any

import torch
import torchrl.trainers.algorithms.configs  # noqa: F401 - registers TorchRL's groups
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from tensordict import TensorDictBase

import cnfp_torchrl.configuration.torchrl_groups  # noqa: F401 - registers ours beside them


def main() -> None:
    """Train on point navigation and count violations."""
    parser = argparse.ArgumentParser(description="Hard constraints in TorchRL's SAC trainer.")
    parser.add_argument("--steps", type=int, default=4000, help="environment steps")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("overrides", nargs="*", help="of the configuration")
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)

    with initialize_config_dir(str(Path(__file__).parent.resolve()), version_base="1.3"):
        given = [f"steps={arguments.steps}", *arguments.overrides]
        config = compose(Path(__file__).stem, overrides=given)
    trainer: Any = instantiate(config.trainer)
    names = trainer.collector.env.constraint_names
    counts = torch.zeros(len(names))
    rewards: list[float] = []

    def watch(batch: TensorDictBase) -> None:
        counts.add_(batch["next", "cost"].flatten(0, -2).sum(0))
        rewards.append(batch["next", "reward"].mean().item())

    trainer.register_op("pre_steps_log", watch)
    trainer.train()
    print(f"mean reward {sum(rewards) / len(rewards):.2f}")
    for name, count in zip(names, counts, strict=True):
        print(f"{name}: {count:.0f} violations in {trainer.collected_frames} steps")


if __name__ == "__main__":
    main()
