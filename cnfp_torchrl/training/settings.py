"""Settings of training and evaluation."""

from __future__ import annotations

from dataclasses import dataclass, replace

from omegaconf import DictConfig, OmegaConf

from cnfp_torchrl.configuration import require_fields


@dataclass(frozen=True)
class TrainingSettings:
    """Numbers of warm-up steps, updates and log entries.

    Args:
        warmup_frames: The environment steps with safe random actions, before the actor acts and
            learns.
        update_ratio: Updates for each environment step.
        log_interval: The environment steps between two entries of the log.
        constraint_bytes: The memory that a stored transition may take for constraints; sets that do
            not fit are computed anew at sampling, which takes a little time.

    Raises:
        ValueError: naming the setting, what was expected and what was given.
    """

    warmup_frames: int = 1000
    update_ratio: float = 0.5
    log_interval: int = 400
    constraint_bytes: int = 64

    def __post_init__(self) -> None:
        require_fields("training", self)


@dataclass(frozen=True)
class CheckpointSettings:
    """How often the state of a run is saved, so that it can go on after it was stopped.

    Args:
        interval: The environment steps between two states; None saves none, not even when stopped.
        keep: The number of newest states that are kept.
        keep_last: Whether a finished run keeps its last state, so that it can be extended.

    Raises:
        ValueError: naming the setting, what was expected and what was given.
    """

    interval: int | None = 10_000
    keep: int = 2
    keep_last: bool = True

    def __post_init__(self) -> None:
        require_fields("checkpoint", self)


@dataclass(frozen=True)
class EvaluationSettings:
    """Number and seed of the episodes that policies are judged by.

    Args:
        episodes: The number of whole episodes for each policy, after training.
        seed: The seed of the environment and of what policies draw, the same for all of them.
        max_steps: The length at which an episode is cut off, for environments that never end one.
        interval: The environment steps of training between two evaluations; None evaluates only
            after.
        interval_episodes: The number of whole episodes of each evaluation during training, at most
            `episodes`.

    Raises:
        ValueError: naming the setting, what was expected and what was given.
    """

    episodes: int = 400
    seed: int = 1000
    max_steps: int = 1000
    interval: int | None = None
    interval_episodes: int = 32

    def __post_init__(self) -> None:
        require_fields("evaluation", self)

    def at_interval(self) -> EvaluationSettings:
        """Return the settings of the evaluations during training."""
        return replace(self, episodes=min(self.interval_episodes, self.episodes))


def require_frames(config: DictConfig) -> None:
    """Refuse a training run that ends within its first batch or its warm-up.

    Raises:
        ValueError: naming the setting, what was expected and what was given.
    """
    total = config.collector.total_frames
    for name in ("collector.frames_per_batch", "training.warmup_frames"):
        given = OmegaConf.select(config, name)
        if given > total:
            raise ValueError(
                f"{name}: expected at most collector.total_frames = {total}, given {given}; lower "
                "it, or train for longer"
            )
