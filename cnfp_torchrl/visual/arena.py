"""The map of point navigation, drawn into a panel, and where an environment has one."""

from __future__ import annotations

from typing import Any

from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle
from torchrl.envs import EnvBase

from cnfp_torchrl.tasks.point_nav import Layout
from cnfp_torchrl.visual.colors import GOAL, INK, RECTANGLE, STATION, ZONE

Point = tuple[float, float]


def layout_of(env: EnvBase) -> Layout | None:
    """Return the map of an environment, or None for one without."""
    layout = getattr(env, "layout", None)
    return layout if isinstance(layout, Layout) else None


def draw_arena(axes: Axes, layout: Layout, *, labels: bool = True) -> None:
    """Draw walls, rectangles, stations and their zones, in arena units.

    Args:
        axes: an empty panel.
        layout: the map.
        labels: name the axes.
    """
    wall = layout.wall
    inside = Rectangle((-wall, -wall), 2 * wall, 2 * wall, transform=axes.transData)
    for station in layout.stations:
        zone = Circle(station, layout.zone_radius, facecolor=ZONE, edgecolor="none")
        axes.add_patch(zone)
        zone.set_clip_path(inside)
        axes.plot(*station, "s", color=STATION, markersize=4, zorder=1.5)
    for x_low, y_low, x_high, y_high in layout.rectangles:
        size = (x_high - x_low, y_high - y_low)
        axes.add_patch(Rectangle((x_low, y_low), *size, facecolor=RECTANGLE, edgecolor="none"))
    axes.add_patch(
        Rectangle((-wall, -wall), 2 * wall, 2 * wall, fill=False, edgecolor=RECTANGLE, linewidth=2)
    )
    axes.set_xlim(-1.04 * wall, 1.04 * wall)
    axes.set_ylim(-1.04 * wall, 1.04 * wall)
    axes.set_aspect("equal")
    ticks = [-wall, 0, wall]
    axes.set_xticks(ticks)
    axes.set_yticks(ticks)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    if labels:
        axes.set_xlabel("x (arena units)")
        axes.set_ylabel("y (arena units)")


def draw_goal(axes: Axes, goal: Point, *, reached: bool = True) -> None:
    """Draw a goal as a star, filled once it is reached."""
    axes.plot(*goal, zorder=4, **_goal(reached))


def draw_start(axes: Axes, position: Point) -> None:
    """Draw where an agent starts."""
    axes.plot(*position, zorder=5, **_START)


def draw_agent(axes: Axes, position: Point) -> None:
    """Draw where an agent is."""
    axes.plot(*position, zorder=7, **_AGENT)


def map_legend() -> list[Line2D]:
    """Return legend entries for the map itself."""
    zone = {"markeredgecolor": ZONE, "markeredgewidth": 2.5, "markersize": 8}
    return [
        _entry("station and zone", marker="s", color=STATION, **zone),
        _entry("obstacle", marker="s", color=RECTANGLE, markersize=7),
    ]


def start_entry() -> Line2D:
    """Return the legend entry of `draw_start`."""
    return _entry("start", **_START)


def agent_entry() -> Line2D:
    """Return the legend entry of `draw_agent`."""
    return _entry("agent", **_AGENT)


def goal_entry(label: str, *, reached: bool = True) -> Line2D:
    """Return the legend entry of `draw_goal`."""
    return _entry(label, **_goal(reached))


def _entry(label: str, **style: Any) -> Line2D:
    return Line2D([], [], label=label, linestyle="none", **style)


_AGENT: dict[str, Any] = {
    "marker": "o",
    "markersize": 6,
    "markerfacecolor": INK,
    "markeredgecolor": "white",
    "markeredgewidth": 0.9,
}

_START: dict[str, Any] = {
    "marker": "o",
    "markersize": 6,
    "markerfacecolor": "white",
    "markeredgecolor": INK,
    "markeredgewidth": 1.5,
}


def _goal(reached: bool) -> dict[str, Any]:
    return {
        "marker": "*",
        "markersize": 11,
        "markerfacecolor": GOAL if reached else "white",
        "markeredgecolor": INK if reached else GOAL,
        "markeredgewidth": 0.6 if reached else 1.2,
    }
