"""What training and evaluation tell those who watch; who that is, they do not know."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.modules import SafeProbabilisticTensorDictSequential
from torchrl.record.loggers import Logger

from cnfp_torchrl.modules import guarded
from cnfp_torchrl.training.agent import build_environment, load_actor
from cnfp_torchrl.training.evaluation import evaluate_seeded
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.settings import EvaluationSettings

RECORDING = "recording.rrd"


class TrainingWatcher(Protocol):
    """Sees every batch that a collector yields, and then episodes of the final evaluation."""

    @property
    def loggers(self) -> Sequence[Logger]:
        """What also wants the scalars of the log."""
        ...

    def see(self, batch: TensorDictBase) -> None:
        """Look at a batch of transitions ``(*environments, time)``, without changing it."""
        ...

    def see_episode(self, episode: Sequence[TensorDictBase]) -> None:
        """Look at the transitions of an episode, each of batch size ``()``; after all batches."""
        ...

    def close(self) -> None:
        """Finish; nothing more will come."""
        ...


class EpisodeWatcher(Protocol):
    """Sees whole episodes, one after another."""

    def see(self, episode: Sequence[TensorDictBase]) -> None:
        """Look at the transitions of an episode, each of batch size ``()``."""
        ...

    def close(self) -> None:
        """Finish; nothing more will come."""
        ...


class Watch(Protocol):
    """What ``conf/visual/`` describes: makes watchers.

    Args:
        episodes: how many episodes of an evaluation to watch, the first ones.
        deterministic: in an evaluation, watch the deterministic policy and not the stochastic one.
    """

    episodes: int
    deterministic: bool

    def of_training(
        self, path: Path, actor: SafeProbabilisticTensorDictSequential, env: EnvBase
    ) -> TrainingWatcher:
        """Return a watcher of a training run that records into a file."""
        ...

    def of_episodes(
        self, path: Path, actor: SafeProbabilisticTensorDictSequential, env: EnvBase
    ) -> EpisodeWatcher:
        """Return a watcher of episodes that records into a file."""
        ...


class Unwatched:
    """Nobody watches."""

    loggers: Sequence[Logger] = ()

    def see(self, batch: TensorDictBase) -> None:
        """Do nothing."""

    def see_episode(self, episode: Sequence[TensorDictBase]) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


def watch_run(
    folder: RunFolder,
    settings: EvaluationSettings,
    watch: Watch,
    recording: Path,
    *,
    trusted: tuple[str, ...] = (),
) -> EpisodeWatcher:
    """Show the first episodes of a run's evaluation, and return the watcher, still open.

    Args:
        folder: a finished run.
        settings: of the evaluation, which they are part of.
        watch: what to show.
        recording: the file to record into.
        trusted: see `RunFolder.load_config`.
    """
    config = folder.load_config(trusted)
    env = build_environment(config, batch_size=[settings.episodes], with_anchor=True)
    actor = load_actor(folder, config, env)
    watcher = watch.of_episodes(recording, actor, env)
    try:
        wanted = first_episodes(watch, settings)
        for episode in replay_episodes(env, actor, settings, wanted, watch.deterministic):
            watcher.see(episode)
    except BaseException:
        watcher.close()
        raise
    return watcher


def first_episodes(watch: Watch, settings: EvaluationSettings) -> range:
    """Return the numbers of the episodes of an evaluation that are watched."""
    return range(min(watch.episodes, settings.episodes))


def replay_episodes(
    env: EnvBase,
    actor: SafeProbabilisticTensorDictSequential,
    settings: EvaluationSettings,
    wanted: Iterable[int],
    deterministic: bool,
) -> list[list[TensorDictBase]]:
    """Return the transitions of some episodes of an evaluation, each of batch size ``()``.

    Args:
        env: of the evaluation's batch size, with anchor and active flags.
        actor: the trained one.
        settings: of the evaluation.
        wanted: the episodes' numbers, from 0.
        deterministic: which of the two policies.
    """
    kept = EpisodeCollector(wanted)
    evaluate_seeded(env, guarded(actor), settings, deterministic=deterministic, see=kept)
    return list(kept.episodes.values())


class EpisodeCollector:
    """Keep the transitions of some episodes of an evaluation; give it to `evaluate` as `see`.

    Args:
        wanted: the episodes' numbers, in the order in which `evaluate` counts them.
    """

    def __init__(self, wanted: Iterable[int]) -> None:
        self.episodes: dict[int, list[TensorDictBase]] = {number: [] for number in wanted}
        self._running: Tensor | None = None
        self._first = 0

    def __call__(self, transition: TensorDictBase) -> None:
        """Keep what is wanted of a transition of any batch size."""
        batch = transition.reshape(-1)
        if self._running is None:
            self._running = torch.ones(len(batch), dtype=torch.bool)
        for number, steps in self.episodes.items():
            index = number - self._first
            if 0 <= index < len(batch) and self._running[index]:
                steps.append(batch[index].clone())
        self._running = self._running & ~batch.get(("next", "done")).reshape(-1).cpu()
        if not bool(self._running.any()):
            self._first += len(batch)
            self._running = None
