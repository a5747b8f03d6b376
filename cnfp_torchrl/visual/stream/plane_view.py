"""One stage of the flow in the plane of two action components."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.components import ImageFormat

from cnfp_torchrl.visual.colors import rgb
from cnfp_torchrl.visual.outlines import set_outline
from cnfp_torchrl.visual.snapshot import FlowSnapshot
from cnfp_torchrl.visual.stream import components, style
from cnfp_torchrl.visual.stream.density import Heat
from cnfp_torchrl.visual.stream.entities import Entities
from cnfp_torchrl.visual.stream.outlines import RayOutlines, within
from cnfp_torchrl.visual.stream.scene import FlowScene, StageView

_TRACKS = 40
_NODES = 96


class PlaneView:
    """Density, samples, sets and the executed action's path after a stage.

    Args:
        stream: where to log; what never changes is logged at once.
        scene: shared by all views.
        view: which stage, which components.
        cells: of the density's grid along each axis.
    """

    def __init__(
        self, stream: rr.RecordingStream, scene: FlowScene, view: StageView, cells: int
    ) -> None:
        self.stage, self.components = view.stage, view.components
        self._entities = Entities(stream, view.path)
        self._is_section = scene.dim > 2
        first, second = (scene.limits[component] for component in view.components)
        self._limits = (*first, *second)
        name = scene.stages[view.stage]
        self._is_last = view.stage + 1 == len(scene.stages)
        color = rgb(scene.colors[name]) if name in scene.colors else style.MUTED
        self._log_frame(scene)
        self._log_styles(scene, color)
        if not self._is_section:
            self._log_density_style(scene, cells)

    def log(self, snapshot: FlowSnapshot, outlines: RayOutlines, heat: Heat | None) -> None:
        """Log one step.

        Args:
            snapshot: with the executed action as sample 0.
            outlines: in this view's plane.
            heat: of this stage, ``(cells, cells)``; None in more than two dimensions.
        """
        entities = self._entities
        samples = self._shown(snapshot, self.stage)[1:]
        # Exact flows stay inside after every stage; what is executed is looked at all the same.
        looked_at = self._is_last or not snapshot.is_safe
        outside = snapshot.outside(self.stage)[1:].numpy() if looked_at else np.zeros(0, dtype=bool)
        if heat is not None:
            entities.log("density", components.pixels(heat))
        if self.stage > 0:
            before = self._shown(snapshot, self.stage - 1)[1 : 1 + _TRACKS]
            tracks = np.stack([before, samples[:_TRACKS]], axis=1)
            entities.lines("way_from_stage_before", tracks)
        any_outside = bool(outside.any())
        entities.points("samples", samples[~outside] if any_outside else samples)
        entities.points("samples_outside", samples[outside] if any_outside else samples[:0])
        self._log_sets(snapshot, outlines)
        path = np.stack([self._shown(snapshot, i)[0] for i in range(self.stage + 1)])
        entities.path("executed", path)

    def _shown(self, snapshot: FlowSnapshot, stage: int) -> NDArray[np.float32]:
        """Return the shown components of all samples after a stage, ``(1 + n, 2)``."""
        samples: NDArray[np.float32] = snapshot.stages[stage].samples.numpy()
        return (
            samples
            if samples.shape[-1] == 2 and self.components == (0, 1)
            else samples[:, list(self.components)]
        )

    def _log_sets(self, snapshot: FlowSnapshot, outlines: RayOutlines) -> None:
        applied = snapshot.stages[self.stage].applied
        if self._is_last:
            # Sets that the flow never applies, such as all those of an unconstrained one.
            for k in set(range(1, len(snapshot.region.sets))) - set(applied):
                other = outlines.of_set(k)
                lines = [] if other is None else within(other, self._limits)
                self._entities.lines(f"sets_not_applied/{k}", lines)
        self._entities.lines("set_so_far", within(outlines.of_intersection(applied), self._limits))
        if applied[-1] == 0:
            return
        own = outlines.of_set(applied[-1])
        self._entities.lines("own_set", [] if own is None else within(own, self._limits))
        # A dropped set has no point in common with the region, and no section to be seen from it.
        dropped = own is None and not self._is_section
        each = snapshot.region.sets[applied[-1]]
        lines = set_outline(each, self._limits, _NODES) if dropped else []
        self._entities.lines("own_set_dropped", lines)

    def _log_frame(self, scene: FlowScene) -> None:
        chosen = list(self.components)
        low, high = np.array(scene.low)[chosen], np.array(scene.high)[chosen]
        (x, y), half = (low + high) / 2, (high - low) / 2
        # Every view is a square, in half widths of the action bounds, the second axis upwards.
        upright = rr.Transform3D(
            translation=[-x / half[0], y / half[1], 0], scale=[1 / half[0], -1 / half[1], 1]
        )
        self._entities.style("", upright)
        corners = np.array([low, (high[0], low[1]), high, (low[0], high[1]), low])
        self._entities.style("bounds", rr.LineStrips2D.from_fields(strips=[corners]))

    def _log_density_style(self, scene: FlowScene, cells: int) -> None:
        (x_low, x_high), (y_low, y_high) = scene.support
        cell = [(x_high - x_low) / cells, (y_high - y_low) / cells, 1]
        image = rr.DepthImage.from_fields(
            format=ImageFormat(cells, cells, color_model="L", channel_datatype="U8"),
            colormap=style.HEAT,
            depth_range=(0, style.HEAT_TOP),
            meter=1.0,
            draw_order=-20,
            magnification_filter="linear",
        )
        place = rr.Transform3D(translation=[x_low, y_low, 0], scale=cell)
        self._entities.style("density", place, image)

    def _log_styles(self, scene: FlowScene, color: style.Color) -> None:
        for name, archetypes in style.stage_styles(self.stage).items():
            self._entities.style(name, *archetypes)
        lines = rr.LineStrips2D.from_fields
        for k, name in enumerate(scene.constraints, start=1):
            if self._is_last and name not in scene.stages:
                own = lines(colors=rgb(scene.colors[name]), radii=style.LINE, draw_order=18)
                self._entities.style(f"sets_not_applied/{k}", own)
        for name, archetype in {
            "way_from_stage_before": lines(colors=style.WAY, radii=style.THIN, draw_order=5),
            "own_set_dropped": lines(colors=style.dimmed(color), radii=style.LINE, draw_order=19),
            "own_set": lines(colors=color, radii=style.WIDE, draw_order=20),
        }.items():
            self._entities.style(name, archetype)
