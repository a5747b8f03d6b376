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

from cnfp_torchrl.modules import flow_head
from cnfp_torchrl.visual.explanation import explain
from cnfp_torchrl.visual.facts import facts_of
from cnfp_torchrl.visual.replay import replay_step
from cnfp_torchrl.visual.snapshot import FlowSnapshot
from cnfp_torchrl.visual.stream import components
from cnfp_torchrl.visual.stream.density import ActionGrid, as_bytes
from cnfp_torchrl.visual.stream.legend import log_legend
from cnfp_torchrl.visual.stream.line_view import LineView
from cnfp_torchrl.visual.stream.map_view import MapView
from cnfp_torchrl.visual.stream.outlines import RayOutlines
from cnfp_torchrl.visual.stream.plane_view import PlaneView
from cnfp_torchrl.visual.stream.scene import EXPLANATION, TIMELINE, FlowScene
from cnfp_torchrl.visual.stream.series import Series


class Recording(Protocol):
    """Where to stream to: an open recording."""

    @property
    def stream(self) -> rr.RecordingStream: ...


class FlowStream:
    """Stream what a flow policy does to Rerun, step by step, on the timeline ``env_step``.

    For each step: the map of point navigation with the allowed moves in place; for each stage of
    the flow its samples, density, sets and the executed action's path; an explanation; time series.
    The base samples are the same in all steps, so that pictures of successive steps compare, and no
    random numbers of the run are used. The same steps give the same recording, byte for byte.

    Logs from the process that it was made in, and keeps a trail of at most 1000 positions.

    Args:
        recording: an open one; Rerun's own stream, or what holds it as ``stream``.
        actor: the policy, from `make_constrained_actor` or `constrain`.
        env: says whether there is a map and what the costs are called; None: neither is shown.
        projections: pairs of action components, counted from 0, a row of views for each, for
            actions of more than two components; None shows the first two.
        samples: how many actions to draw in each step.
        every: log each so manieth step, the first one included; returns, costs and the trail count
            all.
        cells: of the density's grid along each axis.

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
    ) -> None:
        for name, value in (("samples", samples), ("every", every), ("cells", cells)):
            if value < 1:
                raise ValueError(f"{name}: expected a number >= 1, given {value}")
        stream = recording if isinstance(recording, rr.RecordingStream) else recording.stream
        scene = FlowScene.of(actor, env, projections)
        self._stream, self._actor, self._scene, self._every = stream, actor, scene, every
        self._process = os.getpid()
        self._calls = 0
        generator = torch.Generator().manual_seed(0)
        noise = torch.randn(samples, scene.dim, generator=generator)
        # One component after the other in memory, which the flow takes less time for.
        self._noise = noise.T.contiguous().T
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        head = flow_head(actor)
        self._checked: list[NestedKey] = [
            head.action_key,
            *head.parameter_keys,
            ("next", "reward"),
            ("next", "cost"),
        ]
        self._map = None if scene.layout is None else MapView(stream, scene, scene.layout)
        self._series = Series(stream, scene)
        log_legend(stream, scene)
        markdown = rr.TextDocument.from_fields(media_type="text/markdown")
        stream.log(EXPLANATION, markdown, static=True)
        self._facts = facts_of(env)
        views = [view for row in scene.rows() for view in row]
        self._planes = [PlaneView(stream, scene, view, cells) for view in views if scene.dim > 1]
        self._lines = [LineView(stream, scene, view) for view in views if scene.dim == 1]
        self._grid: ActionGrid | None = None
        if scene.dim <= 2:
            self._grid = ActionGrid(scene.support, cells if scene.dim == 2 else 4 * cells)

    @property
    def is_due(self) -> bool:
        """Whether the next step will be logged, and not only counted."""
        return self._calls % self._every == 0

    @property
    def counted_keys(self) -> list[NestedKey]:
        """What is read of a step that is only counted, where it is there."""
        place: list[NestedKey] = [] if self._map is None else ["observation"]
        return [*self._checked, ("next", "done"), *place]

    @torch.no_grad()
    def log_step(self, step: int, transition: TensorDictBase, heading: str = "") -> None:
        """Log one step, or only count it where it is not each so manieth one.

        Args:
            step: of the environment, on the timeline ``env_step``.
            transition: of batch size ``()``: the state with its geometry, the executed action, the
                policy's location and scale, and reward, cost and done under ``next``.
            heading: begins the explanation, such as with the episode that the step belongs to.

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
            self._stream.set_time(TIMELINE, sequence=step)
            self._log_details(replay_step(self._actor, transition, self._noise), heading)
        self._calls += 1
        done = transition.get(("next", "done"), None)
        if done is not None and bool(done.any()):
            self._series.end_episode()
            if self._map is not None:
                self._map.end_episode()

    def _log_details(self, snapshot: FlowSnapshot, heading: str) -> None:
        region = snapshot.region.to(torch.float64)
        outlines: dict[tuple[int, ...], RayOutlines] = {}

        def seen(components: tuple[int, ...]) -> RayOutlines:
            if components not in outlines:
                outlines[components] = RayOutlines(region, components)
            return outlines[components]

        if self._map is not None:
            self._map.log(snapshot, seen((0, 1)))
        densities = None
        if self._grid is not None:
            densities = self._grid.log_densities(snapshot)
        if self._planes:
            heat = None if densities is None else as_bytes(densities)
            for plane in self._planes:
                shown = None if heat is None else heat[plane.stage]
                plane.log(snapshot, seen(plane.components), shown)
        if self._lines and self._grid is not None and densities is not None:
            curves = self._grid.curves(densities)
            for line in self._lines:
                line.log(snapshot, seen((0,)), curves[line.stage])
        facts = None if self._facts is None else self._facts(snapshot.state)
        words = explain(
            snapshot,
            facts=None if facts is None else facts.by_constraint,
            situation=None if facts is None else facts.situation,
        ).markdown()
        # In the first sentence's line: the panel shows few.
        said = f"{heading}: {words}" if heading else words
        self._stream.log(EXPLANATION, components.text(said))
        self._series.log(snapshot)

    def _refuse_what_is_not_finite(self, step: int, transition: TensorDictBase) -> None:
        for key in self._checked:
            value: Tensor | None = transition.get(key, None)
            if value is not None and not all(map(math.isfinite, value.reshape(-1).tolist())):
                raise ValueError(
                    f"{key!r} at step {step}: expected finite numbers, given {value.tolist()}; "
                    "look for the policy's first NaN, which Rerun would draw as nothing"
                )
