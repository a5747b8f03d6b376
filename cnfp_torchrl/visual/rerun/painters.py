"""Painters of a scene's parts: stages, map and legend, from the scene's arrays."""

from __future__ import annotations

from array import array
from collections.abc import Sequence

import numpy as np
import rerun as rr
import torch
from numpy.typing import NDArray
from rerun.components import ImageFormat
from tensordict import TensorDictBase

from cnfp_torchrl.envs import Boxes, Component, Discs, Map, Marks, Polyline, Shape, TaskView
from cnfp_torchrl.visual.colors import rgb
from cnfp_torchrl.visual.outlines import Line
from cnfp_torchrl.visual.rerun import entities, style
from cnfp_torchrl.visual.rerun.entities import Entities
from cnfp_torchrl.visual.scene import Scene
from cnfp_torchrl.visual.setting import Setting, StageView, axis_title

_TRACKS = 40
_TARGETS = 160
_LONGEST_TRAIL = 1000
_RECENT = 12

HEIGHTS_IN_ONE = (-0.45, 1.1)
"""Heights of a view of one component: the highest density is at 1, the sets stand below 0."""
_SAMPLES = (-0.16, -0.04)
_SETS = (-0.22, -0.42)
_BOUNDS = (-0.42, 1.05)

_LEGEND_COLUMNS = 3
_COLUMN_WIDTH, _ROW_HEIGHT = 3.3, 0.62


def axis_room(rows: int) -> float:
    """Return the height of an axis's title, in half widths of what the view shows.

    Titles have one size on the screen, however many rows of views share it.
    """
    return 0.16 * min(rows, 3)


def _log_axes(
    drawn: Entities, titles: Sequence[str], positions: Sequence[tuple[float, float]]
) -> None:
    """Log the titles of the axes, below the frame and above it: Rerun's views have none.

    Args:
        drawn: The entities to log to.
        titles: The titles of the axis to the right and, if there is one, of that upwards.
        positions: The upper ends of the titles.
    """
    labels = [f"{arrow} {title}" for arrow, title in zip("→↑", titles, strict=False)]
    points = rr.Points2D(positions, labels=labels, colors=style.MUTED, radii=0.0, show_labels=True)
    drawn.style("axes", points)


class PlanePainter:
    """Density, samples, sets and the executed action's path after a stage, in a plane.

    Args:
        stream: The stream to log to; what never changes is logged at once.
        setting: The setting of all scenes.
        view: The view, of a stage and components.
        cells: The number of cells of the density's grid along each axis.
    """

    def __init__(
        self, stream: rr.RecordingStream, setting: Setting, view: StageView, cells: int
    ) -> None:
        self._stage, self._components = view.stage, view.components
        self._entities = Entities(stream, style.stage_path(setting, view))
        name = setting.stages[view.stage]
        self._is_last = view.stage + 1 == len(setting.stages)
        color = rgb(setting.colors[name]) if name in setting.colors else style.MUTED
        self._log_frame(setting)
        self._log_styles(setting, color)
        if setting.dim == 2:
            self._log_density_style(setting, cells)

    def log(self, scene: Scene) -> None:
        """Log one step."""
        drawn, stage, components = self._entities, self._stage, self._components
        snapshot, samples = scene.snapshot, scene.samples(stage, components)[1:]
        # Exact flows stay inside after every stage; what is executed is looked at all the same.
        looked_at = self._is_last or not snapshot.is_safe
        outside = snapshot.outside(stage)[1:].numpy() if looked_at else np.zeros(0, dtype=bool)
        if scene.heat is not None:
            drawn.log("density", entities.pixels(scene.heat[stage]))
        if stage > 0:
            drawn.lines("way_from_stage_before", scene.tracks(stage, components, _TRACKS))
        any_outside = bool(outside.any())
        drawn.points("samples", samples[~outside] if any_outside else samples)
        drawn.points("samples_outside", samples[outside] if any_outside else samples[:0])
        self._log_sets(scene)
        drawn.path("executed", scene.path(stage, components))

    def _log_sets(self, scene: Scene) -> None:
        applied, components = scene.snapshot.stages[self._stage].applied, self._components
        if self._is_last:
            # Sets that the flow never applies, such as all those of an unconstrained one.
            for k in set(range(1, len(scene.snapshot.region.sets))) - set(applied):
                self._entities.lines(f"sets_not_applied/{k}", scene.set_lines(k, components))
        self._entities.lines("set_so_far", scene.allowed_lines(self._stage, components))
        if applied[-1] > 0:
            self._entities.lines("own_set", scene.set_lines(applied[-1], components))
            self._entities.lines("own_set_dropped", scene.dropped_lines(applied[-1], components))

    def _log_frame(self, setting: Setting) -> None:
        chosen = list(self._components)
        low, high = np.array(setting.low)[chosen], np.array(setting.high)[chosen]
        (x, y), half = (low + high) / 2, (high - low) / 2
        # Every view is a square, in half widths of the action bounds, the second axis upwards.
        upright = rr.Transform3D(
            translation=[-x / half[0], y / half[1], 0], scale=[1 / half[0], -1 / half[1], 1]
        )
        self._entities.style("", upright)
        corners = np.array([low, (high[0], low[1]), high, (low[0], high[1]), low])
        self._entities.style("bounds", rr.LineStrips2D.from_fields(strips=[corners]))
        titles = [setting.axis_title(component) for component in chosen]
        above = y + (setting.reach + axis_room(len(setting.rows()))) * half[1]
        _log_axes(self._entities, titles, [(x, low[1]), (x, above)])

    def _log_density_style(self, setting: Setting, cells: int) -> None:
        (x_low, x_high), (y_low, y_high) = setting.support
        cell = [(x_high - x_low) / cells, (y_high - y_low) / cells, 1]
        image = rr.DepthImage.from_fields(
            format=ImageFormat(cells, cells, color_model="L", channel_datatype="U8"),
            colormap=style.HEAT,
            depth_range=(0, style.HEAT_TOP),
            meter=1.0,
            draw_order=-20,
            magnification_filter="linear",
        )
        transform = rr.Transform3D(translation=[x_low, y_low, 0], scale=cell)
        self._entities.style("density", transform, image)

    def _log_styles(self, setting: Setting, color: style.Color) -> None:
        for name, archetypes in style.stage_styles(self._stage).items():
            self._entities.style(name, *archetypes)
        lines = rr.LineStrips2D.from_fields
        for k, name in enumerate(setting.constraints, start=1):
            if self._is_last and name not in setting.stages:
                own = lines(colors=rgb(setting.colors[name]), radii=style.LINE, draw_order=18)
                self._entities.style(f"sets_not_applied/{k}", own)
        for name, archetype in {
            "way_from_stage_before": lines(colors=style.WAY, radii=style.THIN, draw_order=5),
            "own_set_dropped": lines(colors=style.dimmed(color), radii=style.LINE, draw_order=19),
            "own_set": lines(colors=color, radii=style.WIDE, draw_order=20),
        }.items():
            self._entities.style(name, archetype)


class LinePainter:
    """Density curve, samples, intervals of the sets and the executed action, on the line.

    Heights have no unit: the density's highest value is drawn at 1, samples are spread over a band
    below 0, and below them lies a bar for the interval of each constraint applied so far.

    Args:
        stream: The stream to log to; what never changes is logged at once.
        setting: The setting of all scenes.
        view: The view of a stage.
    """

    def __init__(self, stream: rr.RecordingStream, setting: Setting, view: StageView) -> None:
        self._entities = Entities(stream, style.stage_path(setting, view))
        self._stage = view.stage
        low, high = setting.low[0], setting.high[0]
        self._middle, self._half = (low + high) / 2, (high - low) / 2
        self._reach = setting.reach
        self._heights = np.linspace(*_SETS, max(len(setting.constraints), 1))
        self._log_styles(setting)

    def log(self, scene: Scene) -> None:
        """Log one step."""
        snapshot = scene.snapshot
        samples = scene.samples(self._stage, (0,))[1:]
        generator = torch.Generator().manual_seed(0)
        spread = torch.rand(samples.shape, generator=generator).numpy()
        points = np.concatenate([samples, _SAMPLES[0] + np.ptp(_SAMPLES) * spread], axis=-1)
        outside = snapshot.outside(self._stage)[1:].numpy()
        self._entities.lines("density", [scene.curves[self._stage]])
        self._entities.points("samples", points[~outside])
        self._entities.points("samples_outside", points[outside])
        applied = snapshot.stages[self._stage].applied
        for k in applied:
            if k > 0:
                ends = scene.interval((k,))
                bar = [] if ends is None else [self._level(ends, self._heights[k - 1])]
                self._entities.lines(f"sets/{k}", bar)
        ends = scene.interval(applied)
        posts = [] if ends is None else [_post(x) for x in self._level(ends, 0.0)[:, 0]]
        self._entities.lines("set_so_far", posts)
        path = scene.path(self._stage, (0,))
        self._entities.path("executed", np.concatenate([path, np.zeros_like(path)], axis=-1))

    def _level(self, ends: tuple[float, float], height: float) -> Line:
        """Return the ends of an interval as points at a height, within the view."""
        reach = self._reach * self._half
        x = np.clip(np.array(ends), self._middle - reach, self._middle + reach)
        return np.stack([x, np.full_like(x, height)], axis=-1)

    def _log_styles(self, setting: Setting) -> None:
        scale = [1 / self._half, -1, 1]
        self._entities.style(
            "", rr.Transform3D(translation=[-self._middle / self._half, 0, 0], scale=scale)
        )
        low, high = self._middle - self._half, self._middle + self._half
        frame = [_post(low), _post(high), np.array([(low, 0.0), (high, 0.0)])]
        self._entities.style("bounds", rr.LineStrips2D.from_fields(strips=frame))
        _log_axes(self._entities, [setting.axis_title(0)], [(self._middle, HEIGHTS_IN_ONE[0])])
        for name, archetypes in style.stage_styles(self._stage).items():
            self._entities.style(name, *archetypes)
        lines = rr.LineStrips2D.from_fields
        curve = lines(colors=style.CURVE, radii=style.LINE, draw_order=5)
        self._entities.style("density", curve)
        for k, name in enumerate(setting.constraints, start=1):
            color = rgb(setting.colors[name])
            self._entities.style(f"sets/{k}", lines(colors=color, radii=style.BAR, draw_order=20))


class MapPainter:
    """The task's map: what stands in it, the goal, the agent with its trail and allowed moves.

    Args:
        stream: The stream to log to; what never changes is logged at once.
        setting: The setting of all scenes.
        plane: The map.
    """

    def __init__(self, stream: rr.RecordingStream, setting: Setting, plane: Map) -> None:
        self._entities = Entities(stream, style.MAP)
        self._view, self._map = setting.view, plane
        self._trail = array("d")
        self._log_map()
        self._log_styles(setting)

    def follow(self, transition: TensorDictBase) -> None:
        """Remember where the agent is, for its trail; of every step, logged or not."""
        self._trail.extend(self._view.position(transition).tolist())
        del self._trail[: -2 * _LONGEST_TRAIL]

    def end_episode(self) -> None:
        """Forget the trail."""
        self._trail = array("d")

    def log(self, scene: Scene) -> None:
        """Log one step."""
        shown = scene.on_map(_TARGETS)
        assert shown is not None
        for k, (own, dropped) in enumerate(zip(shown.sets, shown.dropped, strict=True), start=1):
            self._entities.lines(f"sets/{k}", own)
            self._entities.lines(f"sets_dropped/{k}", dropped)
        if self._map.step_length is not None:
            self._entities.lines("allowed_moves", shown.allowed)
            self._entities.points("targets", shown.targets)
            self._entities.arrow("move", shown.position, shown.move)
        trail = np.array(self._trail).reshape(-1, 2)
        self._entities.lines("trail", [trail[:-_RECENT], trail[-_RECENT - 1 :]])
        if shown.goal is not None:
            self._entities.points("goal", [shown.goal, shown.goal])
        self._entities.points("agent", [shown.position, shown.position])

    def _log_map(self) -> None:
        (x, y), half = self._map.center, self._map.half_width
        # The first axis to the right, the second one upwards, the longer side from -1 to 1.
        middle = [-x / half, y / half, 0] if x or y else None
        self._entities.style("", rr.Transform3D(translation=middle, scale=[1 / half, -1 / half, 1]))
        titles = [
            axis_title(Component(name, self._map.unit), limits)
            for name, limits in zip(self._map.names, (self._map.x, self._map.y), strict=True)
        ]
        above = self._map.y[1] + axis_room(1) * half
        _log_axes(self._entities, titles, [(x, self._map.y[0]), (x, above)])
        for shape in self._map.shapes:
            self._log_shape(shape, rgb(shape.color_on_dark or shape.color))

    def _log_shape(self, shape: Shape, color: style.Color) -> None:
        if isinstance(shape, Polyline):
            line = rr.LineStrips2D([shape.points], colors=color, radii=style.LINE, draw_order=9)
            self._entities.style(shape.name, line)
        elif isinstance(shape, Discs):
            radii = [shape.radius / self._map.half_width] * len(shape.centers)
            discs = rr.Points2D(shape.centers, radii=radii, colors=color, draw_order=1)
            self._entities.style(shape.name, discs)
        elif isinstance(shape, Marks):
            marks = rr.Points2D(shape.points, radii=style.KNOT, colors=color, draw_order=3)
            self._entities.style(shape.name, marks)
        elif isinstance(shape, Boxes):
            # Boxes of Rerun have no filling: an image of one color, stretched, has.
            pixels = np.full((2, 2, 3), color, dtype=np.uint8)
            for i, (x_low, y_low, x_high, y_high) in enumerate(shape.boxes):
                size = [(x_high - x_low) / 2, (y_high - y_low) / 2, 1]
                self._entities.style(
                    f"{shape.name}/{i}",
                    rr.Transform3D(translation=[x_low, y_low, 0], scale=size),
                    rr.Image(pixels, draw_order=2),
                )

    def _log_styles(self, setting: Setting) -> None:
        lines, points = rr.LineStrips2D.from_fields, rr.Points2D.from_fields
        radius = self._map.goal_radius
        goal = style.MARK_INSIDE if radius is None else radius / self._map.half_width
        for name, archetype in {
            "trail": lines(colors=[style.FAINT, style.TRAIL], radii=style.LINE, draw_order=10),
            "targets": points(colors=style.SAMPLE, radii=style.THIN, draw_order=11),
            "allowed_moves": lines(colors=style.PALE, radii=style.LINE, draw_order=22),
            "goal": points(
                colors=[style.GOAL_ZONE, style.GOAL_COLOR],
                radii=[goal, style.MARK_INSIDE],
                draw_order=4,
            ),
            "move": rr.Arrows2D.from_fields(colors=style.EXECUTED, radii=style.LINE, draw_order=30),
            "agent": points(
                colors=[style.BACKGROUND, style.PALE],
                radii=[style.MARK, style.MARK_INSIDE],
                draw_order=32,
            ),
        }.items():
            self._entities.style(name, archetype)
        for k, name in enumerate(setting.constraints, start=1):
            color = rgb(setting.colors[name])
            self._entities.style(f"sets/{k}", lines(colors=color, radii=style.LINE, draw_order=20))
            self._entities.style(
                f"sets_dropped/{k}",
                lines(colors=style.dimmed(color), radii=style.THIN, draw_order=19),
            )


def legend_size(setting: Setting) -> tuple[float, float]:
    """Return width and height of the legend."""
    rows = -(-len(_legend(setting)) // _LEGEND_COLUMNS)
    return _COLUMN_WIDTH * _LEGEND_COLUMNS, _ROW_HEIGHT * rows


def log_legend(stream: rr.RecordingStream, setting: Setting) -> None:
    """Log the legend of stages and map, in their own colors, once for all steps."""
    entries = _legend(setting)
    positions = [
        (
            _COLUMN_WIDTH * (0.5 + i % _LEGEND_COLUMNS),
            _ROW_HEIGHT * (0.2 + i // _LEGEND_COLUMNS),
        )
        for i in range(len(entries))
    ]
    points = rr.Points2D(
        positions,
        labels=list(entries),
        colors=list(entries.values()),
        radii=style.MARK_INSIDE,
        show_labels=True,
    )
    Entities(stream, style.LEGEND).style("", points)


def _legend(setting: Setting) -> dict[str, style.Color]:
    entries = {
        "executed action, its path": style.EXECUTED,
        "samples of the policy": style.SAMPLE,
        "allowed so far": style.PALE,
        **{f"{name} set": rgb(color) for name, color in setting.colors.items()},
        **({"density": style.GLOW} if setting.dim <= 2 else {}),
        "samples outside": style.BREAKS,
    }
    if setting.view.map is not None:
        if type(setting.view).goal is not TaskView.goal:
            entries["goal"] = style.GOAL_COLOR
        for shape in setting.view.map.shapes:
            # Areas speak for themselves; there is little room.
            if isinstance(shape, Marks) and shape.label:
                entries[shape.label] = rgb(shape.color_on_dark or shape.color)
    return entries


def _post(x: float) -> NDArray[np.float64]:
    """Return an upright line at an action."""
    return np.array([(x, _BOUNDS[0]), (x, _BOUNDS[1])])
