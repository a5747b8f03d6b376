"""The stream as training and evaluation use it: ``visual=...`` of the commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.visual.stream.blueprint import TRAINING_PLOTS, flow_blueprint
from cnfp_torchrl.visual.stream.flow_stream import FlowStream
from cnfp_torchrl.visual.stream.logger import RerunLogger
from cnfp_torchrl.visual.stream.sinks import Recording, open_recording
from cnfp_torchrl.visual.stream.viewers import Viewer
from cnfp_torchrl.visual.stream.ways_in import StreamHook

_CLOCKS = ("train/seconds", "train/processor_seconds", "train/steps_per_second")
"""Scalars that differ between two runs of one seed, whose recordings must not."""


class Watch:
    """What to show of a run, and where: a recording, and a live viewer beside it.

    Args:
        viewer: None for the file alone.
        every: in training, each so manieth step of the first agent.
        episodes: how many episodes of an evaluation, each with all its steps.
        deterministic: in an evaluation, the deterministic policy and not the stochastic one.
        samples: how many actions to draw in each step.
        projections: pairs of action components, for actions of more than two.

    Raises:
        ValueError: for a number below 1.
    """

    def __init__(
        self,
        viewer: Viewer | None = None,
        *,
        every: int = 10,
        episodes: int = 1,
        deterministic: bool = False,
        samples: int = 512,
        projections: Sequence[Sequence[int]] | None = None,
    ) -> None:
        for name, value in (("every", every), ("episodes", episodes), ("samples", samples)):
            if value < 1:
                raise ValueError(f"visual.{name}: expected a number >= 1, given {value}")
        self.viewer = viewer
        self.every = every
        self.episodes = episodes
        self.deterministic = deterministic
        self._samples = samples
        self._projections = projections

    def of_training(
        self, path: Path, actor: SafeProbabilisticTensorDictSequential, env: EnvBase
    ) -> WatchedTraining:
        """Return a watcher of a training run that records into a file.

        Raises:
            SinkError: when file or viewer cannot be had.
        """
        return WatchedTraining(*self._open(path, actor, env, self.every, TRAINING_PLOTS))

    def of_episodes(
        self, path: Path, actor: SafeProbabilisticTensorDictSequential, env: EnvBase
    ) -> WatchedEpisodes:
        """Return a watcher of episodes that records into a file.

        Raises:
            SinkError: when file or viewer cannot be had.
        """
        return WatchedEpisodes(*self._open(path, actor, env, 1, None))

    def _open(
        self,
        path: Path,
        actor: SafeProbabilisticTensorDictSequential,
        env: EnvBase,
        every: int,
        plots: Mapping[str, Sequence[str]] | None,
    ) -> tuple[Recording, FlowStream]:
        recording = open_recording(
            path,
            viewer=self.viewer,
            recording_id=str(path.parent.resolve()),
            blueprint=flow_blueprint(actor, env, projections=self._projections, training=plots),
        )
        try:
            stream = FlowStream(
                recording,
                actor,
                env,
                projections=self._projections,
                samples=self._samples,
                every=every,
            )
        except BaseException:
            recording.close()
            raise
        return recording, stream


class WatchedTraining:
    """Stream the first agent of every batch, and the log's scalars.

    Args:
        recording: closed with this.
        stream: of the collector's policy.
    """

    def __init__(self, recording: Recording, stream: FlowStream) -> None:
        self.loggers = [_SeededLogger("recording", stream=recording.stream)]
        self.see = StreamHook(stream)
        self._recording = recording

    def close(self) -> None:
        """Finish the recording."""
        self._recording.close()


class WatchedEpisodes:
    """Stream whole episodes, one after another on the timeline.

    Args:
        recording: closed with this.
        stream: of the policy.
    """

    def __init__(self, recording: Recording, stream: FlowStream) -> None:
        self._recording = recording
        self._stream = stream
        self._steps = 0

    def see(self, episode: Sequence[TensorDictBase]) -> None:
        """Stream the transitions of an episode."""
        for transition in episode:
            self._stream.log_step(self._steps, transition)
            self._steps += 1

    def close(self) -> None:
        """Finish the recording, when whoever looks at it has seen enough."""
        self._recording.stay()
        self._recording.close()


class _SeededLogger(RerunLogger):
    """Leaves out what a clock says, so that one seed gives one recording."""

    def log_scalar(
        self, name: str, value: float | Tensor | Sequence[float], step: int | None = None
    ) -> None:
        if name not in _CLOCKS:
            super().log_scalar(name, value, step)
