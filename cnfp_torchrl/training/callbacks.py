"""What training and evaluation call while they run; what it is for, they do not know."""

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


class EpisodeCallback(Protocol):
    """Called with episodes of an evaluation, one after another."""

    def on_episode(self, episode: Sequence[TensorDictBase]) -> None:
        """Take an episode: its transitions, each of batch size ``()``."""
        ...

    def close(self) -> None:
        """Finish; nothing more will come."""
        ...


class TrainingCallback(EpisodeCallback, Protocol):
    """Called with every batch of training, and then with episodes of the final evaluation."""

    @property
    def loggers(self) -> Sequence[Logger]:
        """TorchRL loggers that get the scalars of training, too."""
        ...

    def continue_at(self, frames: int) -> None:
        """Go on after as many environment steps, of a run that goes on; called before the first."""
        ...

    def on_batch(self, batch: TensorDictBase) -> None:
        """Take a batch of transitions ``(*environments, time)``, without changing it."""
        ...


class CallbackFactory(Protocol):
    """Makes the callbacks of a run: what ``conf/visual/`` describes.

    Args:
        episodes: number of episodes that callbacks get of an evaluation, its first ones.
        deterministic: take them from the deterministic policy and not from the stochastic one.
    """

    episodes: int
    deterministic: bool

    def for_training(
        self, path: Path, actor: SafeProbabilisticTensorDictSequential, env: EnvBase
    ) -> TrainingCallback:
        """Return the callback of a training run, which may record into a file."""
        ...

    def for_evaluation(
        self, path: Path, actor: SafeProbabilisticTensorDictSequential, env: EnvBase
    ) -> EpisodeCallback:
        """Return the callback of an evaluation, which may record into a file."""
        ...


class NoCallback:
    """Does nothing."""

    loggers: Sequence[Logger] = ()

    def continue_at(self, frames: int) -> None:
        """Do nothing."""

    def on_batch(self, batch: TensorDictBase) -> None:
        """Do nothing."""

    def on_episode(self, episode: Sequence[TensorDictBase]) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


def show_episodes(
    folder: RunFolder,
    settings: EvaluationSettings,
    factory: CallbackFactory,
    recording: Path,
    *,
    trusted: tuple[str, ...] = (),
) -> EpisodeCallback:
    """Give the first episodes of a run's evaluation to a callback, and return it, still open.

    Args:
        folder: a finished run.
        settings: those of the evaluation that the episodes are part of.
        factory: the maker of the callback.
        recording: the file to record into.
        trusted: see `RunFolder.load_config`.
    """
    config = folder.load_config(trusted)
    env = build_environment(config, batch_size=[settings.episodes], with_anchor=True)
    actor = load_actor(folder, config, env)
    callback = factory.for_evaluation(recording, actor, env)
    try:
        numbers = first_episodes(factory, settings)
        for episode in replay_episodes(env, actor, settings, numbers, factory.deterministic):
            callback.on_episode(episode)
    except BaseException:
        callback.close()
        raise
    return callback


def first_episodes(factory: CallbackFactory, settings: EvaluationSettings) -> range:
    """Return the numbers of the episodes of an evaluation that callbacks get."""
    return range(min(factory.episodes, settings.episodes))


def replay_episodes(
    env: EnvBase,
    actor: SafeProbabilisticTensorDictSequential,
    settings: EvaluationSettings,
    numbers: Iterable[int],
    deterministic: bool,
) -> list[list[TensorDictBase]]:
    """Return the transitions of some episodes of an evaluation, each of batch size ``()``.

    Args:
        env: the environment, of the evaluation's batch size, with anchor and active flags.
        actor: the trained actor.
        settings: those of the evaluation.
        numbers: the episodes' numbers, from 0.
        deterministic: take the deterministic policy and not the stochastic one.
    """
    recorder = EpisodeRecorder(numbers)
    evaluate_seeded(
        env, guarded(actor, env), settings, deterministic=deterministic, on_step=recorder
    )
    return list(recorder.episodes.values())


class EpisodeRecorder:
    """Keeps the transitions of some episodes of an evaluation, as the `on_step` of `evaluate`.

    Args:
        numbers: the episodes' numbers, in the order in which `evaluate` counts them.
    """

    def __init__(self, numbers: Iterable[int]) -> None:
        self.episodes: dict[int, list[TensorDictBase]] = {number: [] for number in numbers}
        self._running: Tensor | None = None
        self._first = 0

    def __call__(self, transition: TensorDictBase) -> None:
        """Keep a transition of any batch size, where it is of one of the episodes."""
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
