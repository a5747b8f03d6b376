"""A task's map, drawn into a panel, with agent, goal and the allowed moves in place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle

from cnfp_torchrl.envs import Boxes, Component, Discs, Map, Marks, Polyline, TaskView
from cnfp_torchrl.visual.colors import GOAL, INK
from cnfp_torchrl.visual.scene import Scene

_MARGIN = 0.02

AGENT: dict[str, Any] = {
    "marker": "o",
    "markersize": 6,
    "markerfacecolor": INK,
    "markeredgecolor": "white",
    "markeredgewidth": 0.9,
}

START: dict[str, Any] = {
    "marker": "o",
    "markersize": 6,
    "markerfacecolor": "white",
    "markeredgecolor": INK,
    "markeredgewidth": 1.5,
}


def draw_map(axes: Axes, plane: Map, *, labels: bool = True) -> None:
    """Draw what stands in a map, in its units.

    Args:
        axes: An empty panel.
        plane: The map.
        labels: Whether the axes are named.
    """
    (x_low, x_high), (y_low, y_high) = plane.x, plane.y
    inside = Rectangle((x_low, y_low), x_high - x_low, y_high - y_low, transform=axes.transData)
    for shape in plane.shapes:
        if isinstance(shape, Discs):
            for center in shape.centers:
                disc = Circle(center, shape.radius, facecolor=shape.color, edgecolor="none")
                axes.add_patch(disc)
                disc.set_clip_path(inside)
        elif isinstance(shape, Boxes):
            for left, bottom, right, top in shape.boxes:
                size = (right - left, top - bottom)
                box = Rectangle((left, bottom), *size, facecolor=shape.color, edgecolor="none")
                axes.add_patch(box)
        elif isinstance(shape, Marks):
            axes.plot(*np.array(shape.points).T, "s", color=shape.color, markersize=4, zorder=1.5)
        elif isinstance(shape, Polyline):
            axes.plot(*np.array(shape.points).T, color=shape.color, linewidth=2, zorder=1)
    margin = _MARGIN * 2 * plane.half_width
    axes.set_xlim(x_low - margin, x_high + margin)
    axes.set_ylim(y_low - margin, y_high + margin)
    axes.set_aspect("equal")
    axes.set_xticks([x_low, plane.center[0], x_high])
    axes.set_yticks([y_low, plane.center[1], y_high])
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    if labels:
        axes.set_xlabel(axis_label(plane, 0))
        axes.set_ylabel(axis_label(plane, 1))


def axis_label(plane: Map, axis: int) -> str:
    """Return what an axis of a map is called."""
    return Component(plane.names[axis], plane.unit).title


def draw_moves(axes: Axes, scene: Scene, colors: Mapping[str, str]) -> None:
    """Draw the map with each constraint's set, and where the agent may move.

    Args:
        axes: An empty panel.
        scene: A scene of a task with a map.
        colors: The colors of the constraints.
    """
    view, shown = scene.setting.view, scene.on_map(targets=0)
    assert view.map is not None
    assert shown is not None
    draw_map(axes, view.map)
    drawn = zip(scene.setting.constraints, shown.sets, shown.dropped, strict=False)
    for name, own, dropped in drawn:
        for line, dashes in [*((line, "-") for line in own), *((line, ":") for line in dropped)]:
            axes.plot(*line.T, color=colors[name], lw=1.4, linestyle=dashes, zorder=5, label=name)
    for edge in shown.allowed:
        axes.fill(*edge.T, facecolor=(0, 0, 0, 0.18), edgecolor=INK, linewidth=0.9, zorder=6)
    axes.plot(*shown.position, zorder=7, **AGENT)
    if shown.goal is not None:
        draw_goal(axes, (shown.goal[0], shown.goal[1]), reached=False)
    axes.set_title("\n".join(["allowed moves on the map", *_values(scene)]))


def draw_goal(axes: Axes, goal: tuple[float, float], *, reached: bool = True) -> None:
    """Draw a goal as a star, filled once it is reached."""
    axes.plot(*goal, zorder=4, **_goal(reached))


def map_legend(view: TaskView) -> list[Line2D]:
    """Return legend entries for what stands in a task's map."""
    shapes = () if view.map is None else view.map.shapes
    return [
        legend_entry(shape.label, marker="s", color=shape.color, markersize=7)
        for shape in shapes
        if shape.label
    ]


def goal_entry(label: str, *, reached: bool = True) -> Line2D:
    """Return the legend entry of `draw_goal`."""
    return legend_entry(label, **_goal(reached))


def legend_entry(label: str, **style: Any) -> Line2D:
    """Return a legend entry of a mark."""
    return Line2D([], [], label=label, linestyle="none", **style)


def _values(scene: Scene) -> Sequence[str]:
    """Return the task's series in this state, as a line of a title."""
    view = scene.setting.view
    values = view.series_values(scene.snapshot.state) if view.series else {}
    texts = [f"{s.name} {float(values[s.name]):.3g} {s.unit}".rstrip() for s in view.series]
    return [", ".join(texts)] if texts else []


def _goal(reached: bool) -> dict[str, Any]:
    return {
        "marker": "*",
        "markersize": 11,
        "markerfacecolor": GOAL if reached else "white",
        "markeredgecolor": INK if reached else GOAL,
        "markeredgewidth": 0.6 if reached else 1.2,
    }
