"""Callbacks of training and evaluation, such as a stream to a viewer, and their protocol."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.modules import SafeProbabilisticTensorDictSequential
from torchrl.record.loggers import Logger

from cnfp_torchrl.training.agent import build_environment, load_actor
from cnfp_torchrl.training.episodes import record_episode
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.settings import EvaluationSettings

RECORDING = "recording.rrd"


class EpisodeCallback(Protocol):
    """Called with episodes, one after another."""

    def on_episode(self, episode: Sequence[TensorDictBase]) -> None:
        """Take an episode: its transitions, each of batch size ``()``."""
        ...

    def close(self) -> None:
        """Finish; nothing more will come."""
        ...


class TrainingCallback(EpisodeCallback, Protocol):
    """Called with every batch of training, and then with episodes of the trained policy."""

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
    """Make the callbacks of a run: what ``conf/visual/`` describes.

    Args:
        episodes: The number of episodes that callbacks get.
        deterministic: Whether to take them from the deterministic policy and not from the
            stochastic one.
        render_every: The number of steps between two pictures of the environment; 0: none.
    """

    episodes: int
    deterministic: bool
    render_every: int

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
    """A callback that does nothing."""

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
    """Give episodes of a run's policy to a callback, and return it, still open.

    Args:
        folder: A finished run.
        settings: Those of `record_episode`.
        factory: The maker of the callback.
        recording: The file to record into.
        trusted: See `RunFolder.load_config`.
    """
    config = folder.load_config(trusted)
    env = build_environment(config, batch_size=[1], with_anchor=True)
    actor = load_actor(folder, config, env)
    env.reset()  # environments in a row are made here, and can then be asked for names
    callback = factory.for_evaluation(recording, actor, env)
    try:
        give_episodes(callback, factory, settings, env, actor)
    except BaseException:
        callback.close()
        raise
    return callback


def give_episodes(
    callback: EpisodeCallback,
    factory: CallbackFactory,
    settings: EvaluationSettings,
    env: EnvBase,
    actor: SafeProbabilisticTensorDictSequential,
) -> None:
    """Record as many episodes as a callback's maker asks for, and give them to the callback."""
    for number in range(factory.episodes):
        episode = record_episode(
            env,
            actor,
            settings,
            number,
            deterministic=factory.deterministic,
            render_every=factory.render_every,
        )
        callback.on_episode(episode)
