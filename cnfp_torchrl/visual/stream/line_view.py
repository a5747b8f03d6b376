"""One stage of the flow on the line of an action with one component."""

from __future__ import annotations

import numpy as np
import rerun as rr
import torch

from cnfp_torchrl.visual.colors import rgb
from cnfp_torchrl.visual.outlines import Line
from cnfp_torchrl.visual.snapshot import FlowSnapshot
from cnfp_torchrl.visual.stream import style
from cnfp_torchrl.visual.stream.entities import Entities
from cnfp_torchrl.visual.stream.outlines import RayOutlines
from cnfp_torchrl.visual.stream.scene import FlowScene, StageView

_SAMPLES = (-0.16, -0.04)
_SETS = (-0.22, -0.42)
_BOUNDS = (-0.42, 1.05)


class LineView:
    """Density curve, samples, intervals of the sets and the executed action after a stage.

    Heights have no unit: the density's highest value is drawn at 1, samples are spread over a band
    below 0, and below them lies a bar for the interval of each constraint applied so far.

    Args:
        stream: where to log; the static parts are logged at once.
        scene: shared by all views.
        view: which stage.
    """

    def __init__(self, stream: rr.RecordingStream, scene: FlowScene, view: StageView) -> None:
        self._entities = Entities(stream, view.path)
        self.stage = view.stage
        low, high = scene.low[0], scene.high[0]
        self._middle, self._half = (low + high) / 2, (high - low) / 2
        self._reach = scene.reach
        self._heights = np.linspace(*_SETS, max(len(scene.constraints), 1))
        self._log_styles(scene)

    def log(self, snapshot: FlowSnapshot, outlines: RayOutlines, curve: Line) -> None:
        """Log one step.

        Args:
            snapshot: with the executed action as sample 0.
            outlines: the ends of the intervals.
            curve: actions and relative densities of this stage, ``(nodes, 2)``.
        """
        stage = snapshot.stages[self.stage]
        samples = stage.samples[1:].numpy()
        generator = torch.Generator().manual_seed(0)
        spread = torch.rand(samples.shape, generator=generator).numpy()
        points = np.concatenate([samples, _SAMPLES[0] + np.ptp(_SAMPLES) * spread], axis=-1)
        outside = snapshot.outside(self.stage)[1:].numpy()
        self._entities.lines("density", [curve])
        self._entities.points("samples", points[~outside])
        self._entities.points("samples_outside", points[outside])
        for k in stage.applied:
            ends = outlines.of_set(k)
            if k > 0:
                bar = [] if ends is None else [self._level(ends, self._heights[k - 1])]
                self._entities.lines(f"sets/{k}", bar)
        ends = self._level(outlines.of_intersection(stage.applied), 0.0)
        self._entities.lines("set_so_far", [_post(x) for x in ends[:, 0]])
        path = snapshot.path()[: self.stage + 1].numpy()
        self._entities.path("executed", np.concatenate([path, np.zeros_like(path)], axis=-1))

    def _level(self, ends: Line, height: float) -> Line:
        """Return the ends of an interval as points at a height, within the view."""
        reach = self._reach * self._half
        x = np.clip(ends[:, 0], self._middle - reach, self._middle + reach)
        return np.stack([x, np.full_like(x, height)], axis=-1)

    def _log_styles(self, scene: FlowScene) -> None:
        scale = [1 / self._half, -1, 1]
        self._entities.style(
            "", rr.Transform3D(translation=[-self._middle / self._half, 0, 0], scale=scale)
        )
        low, high = self._middle - self._half, self._middle + self._half
        frame = [_post(low), _post(high), np.array([(low, 0.0), (high, 0.0)])]
        self._entities.style("bounds", rr.LineStrips2D.from_fields(strips=frame))
        for name, archetypes in style.stage_styles(self.stage).items():
            self._entities.style(name, *archetypes)
        lines = rr.LineStrips2D.from_fields
        curve = lines(colors=style.CURVE, radii=style.LINE, draw_order=5)
        self._entities.style("density", curve)
        for k, name in enumerate(scene.constraints, start=1):
            color = rgb(scene.colors[name])
            self._entities.style(f"sets/{k}", lines(colors=color, radii=style.BAR, draw_order=20))


def _post(x: float) -> Line:
    """Return an upright line at an action."""
    return np.array([(x, _BOUNDS[0]), (x, _BOUNDS[1])])
