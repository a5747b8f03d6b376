"""The curve of a training run: rewards of steps and returns of episodes, whoever trains."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

CURVE = "curve.json"


class Curve:
    """Take every step of training.

    Args:
        agents: The number of agents that act together.
        warmup: The number of environment steps before learning starts.
        interval: The number of environment steps of an interval of rewards.
    """

    def __init__(self, agents: int, warmup: int, interval: int = 600) -> None:
        self.steps = 0
        self.interval, self.warmup = interval, warmup
        self.reward_steps: list[int] = []
        self.rewards: list[float] = []
        self.episode_steps: list[int] = []
        self.episode_returns: list[float] = []
        self._returns = torch.zeros(agents, dtype=torch.float64)
        self._sum, self._count = 0.0, 0
        self._learning_since: tuple[int, float] | None = None
        self._last = time.perf_counter()

    def add(self, reward: Tensor, done: Tensor) -> None:
        """Take a step of all agents, rewards and ends ``(agents,)``."""
        self.steps += len(reward)
        self._returns += reward.double()
        for index in done.nonzero().squeeze(-1).tolist():
            self.episode_steps.append(self.steps)
            self.episode_returns.append(round(float(self._returns[index]), 3))
            self._returns[index] = 0.0
        self._sum, self._count = self._sum + float(reward.sum()), self._count + len(reward)
        if self._count >= self.interval:
            self.reward_steps.append(self.steps)
            self.rewards.append(round(self._sum / self._count, 5))
            self._sum, self._count = 0.0, 0
        self._last = time.perf_counter()
        if self._learning_since is None and self.steps > self.warmup:
            self._learning_since = self.steps, self._last

    def kept(self) -> dict[str, Any]:
        """Return the entries of a record."""
        assert self._learning_since is not None, "expected a run beyond its warm-up"
        steps, since = self._learning_since
        return {
            "steps": self.steps,
            "steps_per_second": round((self.steps - steps) / (self._last - since), 1),
            "reward_steps": self.reward_steps,
            "rewards": self.rewards,
            "episode_steps": self.episode_steps,
            "episode_returns": self.episode_returns,
        }


class CurveCallback:
    """Keep the curve of a training run beside it; take the place of a stream to a viewer.

    Args:
        warmup: See `Curve`.
    """

    episodes, deterministic, loggers = 0, False, ()

    def __init__(self, warmup: int) -> None:
        self.warmup = warmup

    def for_training(self, path: Path, actor: Any, env: EnvBase) -> CurveCallback:
        """Return itself, with a new curve."""
        self.curve = Curve(env.batch_size.numel(), self.warmup)
        self._path = path.with_name(CURVE)
        return self

    def on_batch(self, batch: TensorDictBase) -> None:
        """Take a batch of transitions ``(agents, time)``."""
        outcome = batch.get("next").select("reward", "done").cpu()
        rewards, ends = (outcome.get(key).squeeze(-1).T for key in ("reward", "done"))
        for reward, done in zip(rewards, ends, strict=True):
            self.curve.add(reward, done)

    def on_episode(self, episode: Sequence[TensorDictBase]) -> None:
        """Take no episodes."""

    def close(self) -> None:
        """Write the curve."""
        self._path.write_text(json.dumps(self.curve.kept()))
