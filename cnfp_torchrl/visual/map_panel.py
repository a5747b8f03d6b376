"""The panel of the map: the allowed moves in place."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes

from cnfp_torchrl.tasks.point_nav import Layout
from cnfp_torchrl.tasks.point_nav.layout import BATTERY_FULL
from cnfp_torchrl.visual.arena import draw_agent, draw_arena, draw_goal
from cnfp_torchrl.visual.colors import INK
from cnfp_torchrl.visual.outlines import region_outline, set_outline
from cnfp_torchrl.visual.snapshot import FlowSnapshot


def draw_moves(
    axes: Axes, snapshot: FlowSnapshot, layout: Layout, colors: Mapping[str, str]
) -> None:
    """Draw the map of point navigation with each constraint's set, and where the agent may move.

    Args:
        axes: an empty panel.
        snapshot: of a state of point navigation, with its ``observation``.
        layout: the map.
        colors: of the constraints.
    """
    draw_arena(axes, layout)
    x, y, battery, goal_x, goal_y = snapshot.state["observation"].tolist()
    step, wall, place = layout.step_length, layout.wall, np.array([x, y])
    view = ((-wall - x) / step, (wall - x) / step, (-wall - y) / step, (wall - y) / step)
    for k, name in enumerate(snapshot.constraint_names, start=1):
        dashes = "-" if snapshot.is_active(k) else (0, (1.2, 1.8))
        for line in set_outline(snapshot.region.sets[k], view):
            moved = place + step * line
            axes.plot(*moved.T, color=colors[name], lw=1.4, linestyle=dashes, zorder=5, label=name)
    edge = place + step * region_outline(snapshot.region, range(len(snapshot.region.sets)))
    axes.fill(*edge.T, facecolor=(0, 0, 0, 0.18), edgecolor=INK, linewidth=0.9, zorder=6)
    draw_agent(axes, (x, y))
    draw_goal(axes, (goal_x, goal_y), reached=False)
    axes.set_title(f"allowed moves on the map\nbattery {BATTERY_FULL * battery:.0f} %")
