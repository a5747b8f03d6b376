"""The stream as training and evaluation use it: ``visual=...`` of the commands."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.modules import flow_head
from cnfp_torchrl.visual.rerun.blueprint import TRAINING_PLOTS, flow_blueprint
from cnfp_torchrl.visual.rerun.hooks import StreamHook
from cnfp_torchrl.visual.rerun.logger import RerunLogger
from cnfp_torchrl.visual.rerun.recording import Recording, open_recording
from cnfp_torchrl.visual.rerun.stream import FlowStream
from cnfp_torchrl.visual.rerun.style import TIMELINE, episode_timeline
from cnfp_torchrl.visual.rerun.viewers import Viewer
from cnfp_torchrl.visual.setting import Setting

_CLOCKS = ("train/seconds", "train/processor_seconds", "train/steps_per_second")
"""Scalars that differ between two runs of one seed, whose recordings must not."""


class RunStream:
    """What to show of a run, and where: a recording, and a live viewer beside it.

    Args:
        viewer: The viewer; None for the file alone.
        every: The interval n: in training, every n-th step of the first agent is recorded.
        episodes: The number of episodes of the trained policy, each with all its steps.
        deterministic: Whether the policy is the deterministic one in these, and not the stochastic
            one.
        render_every: The number of steps, in these, between two pictures of the environment; 0:
            none.
        samples: The number of actions drawn in each step.
        projections: Pairs of action components, for actions of more than two.

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
        render_every: int = 5,
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
        self.render_every = render_every
        self._samples = samples
        self._projections = projections

    def for_training(
        self, path: Path, actor: SafeProbabilisticTensorDictSequential, env: EnvBase
    ) -> TrainingStream:
        """Return the stream of a training run into a file.

        Raises:
            SinkError: when file or viewer cannot be had.
        """
        recording, stream = self._open(path, actor, env, TRAINING_PLOTS)
        training = stream(self.every, TIMELINE)
        return TrainingStream(recording, training, EpisodeStream(stream, self._policy))

    def for_evaluation(
        self, path: Path, actor: SafeProbabilisticTensorDictSequential, env: EnvBase
    ) -> EvaluationStream:
        """Return the stream of episodes into a file.

        Raises:
            SinkError: when file or viewer cannot be had.
        """
        recording, stream = self._open(path, actor, env, None)
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
    ) -> tuple[Recording, Callable[[int, str], FlowStream]]:
        """Return an open recording, and what makes its streams: of every n-th step, a timeline."""
        setting = Setting.of(flow_head(actor), env, self._projections)
        first = TIMELINE if plots else episode_timeline(0)
        blueprint = flow_blueprint(
            actor, env, projections=self._projections, training=plots, timeline=first
        )
        recording = open_recording(
            path,
            viewer=self.viewer,
            recording_id=str(path.parent.resolve()),
            blueprint=blueprint,
        )

        def stream(every: int, timeline: str) -> FlowStream:
            return FlowStream(
                recording,
                actor,
                samples=self._samples,
                every=every,
                timeline=timeline,
                setting=setting,
            )

        return recording, stream


class EpisodeStream:
    """Stream whole episodes, each on a timeline of its own.

    Args:
        stream: A function that returns a stream of every n-th step on a timeline.
        policy: The policy's kind, ``stochastic`` or ``deterministic``.
    """

    def __init__(self, stream: Callable[[int, str], FlowStream], policy: str) -> None:
        self._stream, self._policy = stream, policy
        self._number = 0

    def __call__(self, episode: Sequence[TensorDictBase]) -> None:
        """Stream the transitions of the next episode."""
        stream = self._stream(1, episode_timeline(self._number))
        for step, transition in enumerate(episode):
            # Counted from 0, as ``cnfp-explain`` does.
            position = f"episode {self._number}, step {step} of {len(episode)}"
            stream.log_step(step, transition, f"Trained policy, {self._policy}, {position}")
        self._number += 1


class TrainingStream:
    """Stream the first agent of every batch, the log's scalars, and episodes when it is trained.

    Args:
        recording: The recording, closed with this.
        stream: The stream of the collector's policy.
        episodes: The stream of episodes.
    """

    def __init__(self, recording: Recording, stream: FlowStream, episodes: EpisodeStream) -> None:
        self.loggers = [_SeededLogger("recording", stream=recording.stream)]
        self.on_batch = StreamHook(stream)
        self.on_episode = episodes
        self._recording = recording

    def continue_at(self, frames: int) -> None:
        """Go on along the timeline after as many steps of all agents."""
        self.on_batch.frames = frames

    def close(self) -> None:
        """Finish the recording."""
        self._recording.close()


class EvaluationStream:
    """Stream whole episodes, and stay for whoever looks at them.

    Args:
        recording: The recording, closed with this.
        episodes: The stream of episodes.
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
