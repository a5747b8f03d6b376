"""Settings of training and evaluation, refused when they make no sense."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TrainingSettings:
    """How data, updates and log entries follow each other.

    Args:
        warmup_frames: environment steps with safe random actions, before the actor acts and learns.
        update_ratio: updates for each environment step.
        log_interval: environment steps between two entries of the log.

    Raises:
        ValueError: naming the setting, what was expected and what was given.
    """

    warmup_frames: int = 1000
    update_ratio: float = 0.5
    log_interval: int = 400

    def __post_init__(self) -> None:
        _require(self.warmup_frames >= 0, "training.warmup_frames", ">= 0", self.warmup_frames)
        _require(self.update_ratio >= 0, "training.update_ratio", ">= 0", self.update_ratio)
        _require(self.log_interval >= 1, "training.log_interval", ">= 1", self.log_interval)


@dataclass(frozen=True)
class EvaluationSettings:
    """How a policy is judged.

    Args:
        episodes: whole episodes for each policy.
        seed: of the environment's starts and goals, the same for all policies.

    Raises:
        ValueError: naming the setting, what was expected and what was given.
    """

    episodes: int = 400
    seed: int = 1000

    def __post_init__(self) -> None:
        _require(self.episodes >= 1, "evaluation.episodes", ">= 1", self.episodes)


def _require(good: bool, name: str, expected: str, given: float) -> None:
    if not good:
        raise ValueError(f"{name}: expected a number {expected}, given {given}")
