"""The stream of a flow policy: everything that happens in a step, in time with the environment."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Protocol

import rerun as rr
import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.keys import COST_KEY, PIXELS_KEY, REWARD_KEY
from cnfp_torchrl.modules import flow_head
from cnfp_torchrl.visual.replay import replay_step
from cnfp_torchrl.visual.rerun import entities
from cnfp_torchrl.visual.rerun.painters import (
    LinePainter,
    MapPainter,
    PlanePainter,
    log_legend,
)
from cnfp_torchrl.visual.rerun.series import SeriesPainter
from cnfp_torchrl.visual.rerun.style import EXPLANATION, PICTURE, TIMELINE
from cnfp_torchrl.visual.scene import Detail, Scene
from cnfp_torchrl.visual.setting import Setting
from cnfp_torchrl.visual.snapshot import FlowSnapshot

_JPEG_QUALITY = 85


class Recording(Protocol):
    """Where to stream to: an open recording."""

    @property
    def stream(self) -> rr.RecordingStream: ...


class FlowStream:
    """Stream what a flow policy does to Rerun, step by step.

    For each step: the environment's picture at ``pixels``, where it has one; the task's map, if
    there is one, with the allowed moves in place; for each stage of the flow its samples, density,
    sets and the executed action's path; an explanation; series.
    The base samples are the same in all steps, so that pictures of successive steps compare, and no
    random numbers of the run are used. The same steps give the same recording, byte for byte.

    Logs from the process that it was made in, and keeps a trail of at most 1000 positions.

    Args:
        recording: An open recording; Rerun's own stream, or what holds it as ``stream``.
        actor: The policy, from `make_constrained_actor` or `constrain`.
        env: The environment, which shows its task (`cnfp_torchrl.envs`) and says what the costs are
            called; None: neither is shown.
        projections: Pairs of action components, counted from 0, a row of views for each, for
            actions of more than two components; None shows each component once.
        samples: The number of actions drawn in each step.
        every: The interval n: every n-th step is logged, the first one included; returns, costs and
            the trail count all.
        cells: The number of cells of the density's grid along each axis.
        timeline: The timeline that the steps are counted on.
        setting: What is shown, as another stream's `setting`; None finds it by env and projections.

    Raises:
        ValueError: for a number below 1, a projection that is none, or a flow without density.
    """

    def __init__(
        self,
        recording: Recording | rr.RecordingStream,
        actor: SafeProbabilisticTensorDictSequential,
        env: EnvBase | None = None,
        *,
        projections: Sequence[Sequence[int]] | None = None,
        samples: int = 512,
        every: int = 1,
        cells: int = 40,
        timeline: str = TIMELINE,
        setting: Setting | None = None,
    ) -> None:
        for name, value in (("samples", samples), ("every", every), ("cells", cells)):
            if value < 1:
                raise ValueError(f"{name}: expected a number >= 1, given {value}")
        stream = recording if isinstance(recording, rr.RecordingStream) else recording.stream
        if setting is None:
            setting = Setting.of(flow_head(actor), env, projections)
        self._stream, self._actor, self._every = stream, actor, every
        self.setting = setting
        """What the pictures of all steps have in common."""
        self._timeline, self._process = timeline, os.getpid()
        self._calls = 0
        generator = torch.Generator().manual_seed(0)
        noise = torch.randn(samples, setting.dim, generator=generator)
        # One component after the other in memory, which the flow takes less time for.
        self._noise = noise.T.contiguous().T
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        head = flow_head(actor)
        self._checked: list[NestedKey] = [
            head.action_key,
            *head.parameter_keys,
            ("next", REWARD_KEY),
            ("next", COST_KEY),
        ]
        plane = setting.view.map
        self._map = None if plane is None else MapPainter(stream, setting, plane)
        self._series = SeriesPainter(stream, setting)
        log_legend(stream, setting)
        markdown = rr.TextDocument.from_fields(media_type="text/markdown")
        stream.log(EXPLANATION, markdown, static=True)
        views = [view for row in setting.rows() for view in row]
        self._stages: list[PlanePainter | LinePainter] = [
            LinePainter(stream, setting, view)
            if setting.dim == 1
            else PlanePainter(stream, setting, view, cells)
            for view in views
        ]
        self._detail = Detail(cells)
        self._grid = setting.grid(cells) if setting.dim <= 2 else None

    @property
    def is_due(self) -> bool:
        """Whether the next step will be logged, and not only counted."""
        return self._calls % self._every == 0

    @property
    def counted_keys(self) -> list[NestedKey] | None:
        """What is read of a step that is only counted, where it is there; None where unknown."""
        position = [] if self._map is None else self.setting.view.position_keys
        if self._map is not None and not position:
            return None
        return [*self._checked, ("next", "done"), *position]

    @torch.no_grad()
    def log_step(self, step: int, transition: TensorDictBase, heading: str = "") -> None:
        """Log one step, or only count it where it is not every n-th one.

        Args:
            step: The step of the environment, on the stream's timeline.
            transition: A transition of batch size ``()``: the state with its geometry, the executed
                action, the policy's location and scale, and reward, cost and done under ``next``.
            heading: The beginning of the explanation, such as the episode that the step belongs to.

        Raises:
            ValueError: when the transition is a batch, or a number in it is not finite, which
                Rerun would draw as nothing.
            MissingGeometryError: when the action or geometry is missing.
            RuntimeError: in a process other than the stream's own, where nothing would arrive.
        """
        if os.getpid() != self._process:
            raise RuntimeError(
                "FlowStream: expected to log from the process that opened the recording, given "
                "another one, whose data would be lost; stream in the main process, such as by "
                "StreamHook on the collector"
            )
        if transition.batch_size != torch.Size():
            raise ValueError(
                "transition: expected one step (batch size ()), given "
                f"{tuple(transition.batch_size)}; index it"
            )
        self._refuse_what_is_not_finite(step, transition)
        self._series.follow(transition)
        if self._map is not None:
            self._map.follow(transition)
        if self.is_due:
            # What another stream of this thread has set would go on counting there.
            self._stream.reset_time()
            self._stream.set_time(self._timeline, sequence=step)
            self._log_picture(transition.get(PIXELS_KEY, None))
            self._log_scene(replay_step(self._actor, transition, self._noise), heading)
        self._calls += 1
        done = transition.get(("next", "done"), None)
        if done is not None and bool(done.any()):
            self._series.end_episode()
            if self._map is not None:
                self._map.end_episode()

    def _log_picture(self, pixels: Tensor | None) -> None:
        if pixels is None:
            return
        # Some environments put the channels first, as networks take them.
        image = pixels.movedim(0, -1) if pixels.shape[0] == 3 else pixels
        self._stream.log(PICTURE, rr.Image(image.cpu().numpy()).compress(_JPEG_QUALITY))

    def _log_scene(self, snapshot: FlowSnapshot, heading: str) -> None:
        scene = Scene(self.setting, snapshot, self._detail, self._grid)
        if self._map is not None:
            self._map.log(scene)
        for painter in self._stages:
            painter.log(scene)
        explanation = scene.explanation.markdown()
        # In the first sentence's line: the panel shows few.
        content = f"{heading}: {explanation}" if heading else explanation
        self._stream.log(EXPLANATION, entities.text(content))
        self._series.log(scene)

    def _refuse_what_is_not_finite(self, step: int, transition: TensorDictBase) -> None:
        for key in self._checked:
            value: Tensor | None = transition.get(key, None)
            if value is not None and not all(map(math.isfinite, value.reshape(-1).tolist())):
                raise ValueError(
                    f"{key!r} at step {step}: expected finite numbers, given {value.tolist()}; "
                    "look for the policy's first NaN, which Rerun would draw as nothing"
                )
