"""The stream as training and evaluation use it: ``visual=...`` of the commands."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.visual.rerun.blueprint import TRAINING_PLOTS, flow_blueprint
from cnfp_torchrl.visual.rerun.hooks import StreamHook
from cnfp_torchrl.visual.rerun.logger import RerunLogger
from cnfp_torchrl.visual.rerun.recording import Recording, open_recording
from cnfp_torchrl.visual.rerun.stream import FlowStream
from cnfp_torchrl.visual.rerun.viewers import Viewer

_CLOCKS = ("train/seconds", "train/processor_seconds", "train/steps_per_second")
"""Scalars that differ between two runs of one seed, whose recordings must not."""


class RunStream:
    """What to show of a run, and where: a recording, and a live viewer beside it.

    Args:
        viewer: None for the file alone.
        every: in training, every n-th step of the first agent.
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

    def for_training(
        self, path: Path, actor: SafeProbabilisticTensorDictSequential, env: EnvBase
    ) -> TrainingStream:
        """Return the stream of a training run into a file.

        Raises:
            SinkError: when file or viewer cannot be had.
        """
        recording = self._open(path, actor, env, TRAINING_PLOTS)

        def episodes(step: int) -> EpisodeStream:
            return EpisodeStream(self._stream(recording, actor, env, 1), self._policy, step)

        return TrainingStream(recording, self._stream(recording, actor, env, self.every), episodes)

    def for_evaluation(
        self, path: Path, actor: SafeProbabilisticTensorDictSequential, env: EnvBase
    ) -> EvaluationStream:
        """Return the stream of episodes into a file.

        Raises:
            SinkError: when file or viewer cannot be had.
        """
        recording = self._open(path, actor, env, None)
        stream = self._stream(recording, actor, env, 1)
        return EvaluationStream(recording, EpisodeStream(stream, self._policy))

    @property
    def _policy(self) -> str:
        return "deterministic" if self.deterministic else "stochastic"

    def _open(
        self,
        path: Path,
        actor: SafeProbabilisticTensorDictSequential,
        env: EnvBase,
        plots: Mapping[str, Sequence[str]] | None,
    ) -> Recording:
        return open_recording(
            path,
            viewer=self.viewer,
            recording_id=str(path.parent.resolve()),
            blueprint=flow_blueprint(actor, env, projections=self._projections, training=plots),
        )

    def _stream(
        self,
        recording: Recording,
        actor: SafeProbabilisticTensorDictSequential,
        env: EnvBase,
        every: int,
    ) -> FlowStream:
        """Return a stream to a recording, which is closed where there can be none."""
        try:
            return FlowStream(
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


class EpisodeStream:
    """Stream whole episodes of an evaluation, one after another on the timeline.

    Args:
        stream: of the policy.
        policy: ``stochastic`` or ``deterministic``.
        step: of the first transition, on the timeline.
    """

    def __init__(self, stream: FlowStream, policy: str, step: int = 0) -> None:
        self._stream, self._policy = stream, policy
        self._next_step = step
        self._episode = 0

    def __call__(self, episode: Sequence[TensorDictBase]) -> None:
        """Stream the transitions of the next episode."""
        for number, transition in enumerate(episode):
            # Counted from 0, as ``cnfp-explain`` does.
            position = f"episode {self._episode}, step {number} of {len(episode)}"
            heading = f"Evaluation, {position}, {self._policy} policy"
            self._stream.log_step(self._next_step, transition, heading)
            self._next_step += 1
        self._episode += 1


class TrainingStream:
    """Stream the first agent of every batch, the log's scalars, and episodes behind them.

    Args:
        recording: closed with this.
        stream: of the collector's policy.
        episodes: returns the stream of episodes that begin at a step of the timeline.
    """

    def __init__(
        self, recording: Recording, stream: FlowStream, episodes: Callable[[int], EpisodeStream]
    ) -> None:
        self.loggers = [_SeededLogger("recording", stream=recording.stream)]
        self.on_batch = StreamHook(stream)
        self._recording = recording
        self._make_episodes = episodes
        self._episodes: EpisodeStream | None = None

    def continue_at(self, frames: int) -> None:
        """Go on along the timeline after as many steps of all agents."""
        self.on_batch.frames = frames

    def on_episode(self, episode: Sequence[TensorDictBase]) -> None:
        """Stream the transitions of an episode, behind all that was seen before."""
        if self._episodes is None:
            self._episodes = self._make_episodes(self.on_batch.frames)
        self._episodes(episode)

    def close(self) -> None:
        """Finish the recording."""
        self._recording.close()


class EvaluationStream:
    """Stream whole episodes, and stay for whoever looks at them.

    Args:
        recording: closed with this.
        episodes: the stream of them.
    """

    def __init__(self, recording: Recording, episodes: EpisodeStream) -> None:
        self._recording = recording
        self.on_episode = episodes

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
