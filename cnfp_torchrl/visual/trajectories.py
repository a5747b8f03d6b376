"""Episodes on the map of point navigation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from cnfp_torchrl.tasks.point_nav import Layout
from cnfp_torchrl.tasks.point_nav.layout import BATTERY_FULL
from cnfp_torchrl.visual.arena import (
    draw_arena,
    draw_goal,
    draw_start,
    goal_entry,
    map_legend,
    start_entry,
)
from cnfp_torchrl.visual.canvas import house_style, new_figure
from cnfp_torchrl.visual.colors import INK, constraint_colors

BATTERY_COLORS = LinearSegmentedColormap.from_list(
    "battery", ["#2B0B3F", "#8C2981", "#E8543E", "#FDB42F"]
)
"""Dark when empty, light when full: readable in gray and with any color vision."""

_COLUMNS = 3
_MARKS = ("x", "+", "1", "2")


@dataclass(frozen=True)
class Episode:
    """What happened to one agent, step by step.

    Args:
        positions: ``(steps + 1, 2)``, arena units.
        battery: in percent, before each step and at the end, ``(steps + 1,)``.
        goals: ``(steps + 1, 2)``, arena units.
        rewards: ``(steps,)``.
        costs: the indicators, ``(steps, K)``.
    """

    positions: NDArray[np.float32]
    battery: NDArray[np.float32]
    goals: NDArray[np.float32]
    rewards: NDArray[np.float32]
    costs: NDArray[np.float32]

    @property
    def goals_reached(self) -> NDArray[np.float32]:
        """The goals reached, in order, ``(reached, 2)``: those that were replaced by another."""
        replaced = (self.goals[1:] != self.goals[:-1]).any(-1)
        return self.goals[:-1][replaced]


@torch.no_grad()
def record_episodes(
    env: EnvBase, policy: TensorDictModuleBase, *, max_steps: int = 1000
) -> list[Episode]:
    """Run one episode for each batch element of a point navigation environment.

    Args:
        env: `PointNavEnv` with any transforms, ``(batch,)``.
        policy: writes ``action``; draws by the exploration type in force.
        max_steps: cut longer episodes here.
    """
    rollout = env.rollout(max_steps, policy, break_when_any_done=True)
    observed = torch.cat(
        [rollout["observation"], rollout["next", "observation"][:, -1:]], dim=1
    ).cpu()
    rewards, costs = rollout["next", "reward"].squeeze(-1).cpu(), rollout["next", "cost"].cpu()
    return [
        Episode(
            positions=observed[i, :, :2].numpy(),
            battery=BATTERY_FULL * observed[i, :, 2].numpy(),
            goals=observed[i, :, 3:].numpy(),
            rewards=rewards[i].numpy(),
            costs=costs[i].numpy(),
        )
        for i in range(len(rollout))
    ]


def trajectories(
    layout: Layout,
    episodes: Sequence[Episode],
    constraint_names: Sequence[str] = (),
    *,
    colors: Mapping[str, str] | None = None,
    title: str = "Episodes",
) -> Figure:
    """Draw each episode on a map of its own, the line colored by the battery's charge.

    Where a violating step ends stands a cross in the constraint's color.

    Args:
        layout: the map.
        episodes: one for each panel.
        constraint_names: of the columns of the episodes' costs.
        colors: of the constraints; None chooses them by name.
        title: above the panels.
    """
    colors = dict(colors or constraint_colors(constraint_names))
    columns = min(len(episodes), _COLUMNS)
    rows = -(-len(episodes) // columns)
    with house_style():
        figure = new_figure(3.0 * columns + 0.9, 3.1 * rows + 0.8)
        figure.suptitle(title)
        panels = []
        line = None
        for i, episode in enumerate(episodes):
            axes = figure.add_subplot(rows, columns, i + 1)
            panels.append(axes)
            draw_arena(axes, layout, labels=False)
            if i % columns == 0:
                axes.set_ylabel("y (arena units)")
            if i + columns >= len(episodes):
                axes.set_xlabel("x (arena units)")
            line = _draw_episode(axes, episode)
            broken = _draw_violations(axes, episode, constraint_names, colors)
            total, reached = float(episode.rewards.sum()), len(episode.goals_reached)
            counted = "1 goal" if reached == 1 else f"{reached} goals"
            # A true minus sign, as on the axes.
            axes.set_title(f"return {total:.1f} · {counted}{broken}".replace("-", "\N{MINUS SIGN}"))
        assert line is not None
        bar = figure.colorbar(line, ax=panels, shrink=0.7, aspect=30, label="battery (%)")
        bar.outline.set_visible(False)
        bar.ax.axhline(layout.battery_threshold, color=INK, linewidth=1.2)
        crosses = [
            Line2D([], [], marker=mark, linestyle="none", color=colors[n], label=f"breaks {n}")
            for i, (n, mark) in enumerate(zip(constraint_names, cycle(_MARKS), strict=False))
            if any(episode.costs[:, i].any() for episode in episodes)
        ]
        goals = [goal_entry("goal reached"), goal_entry("last goal", reached=False)]
        entries = [start_entry(), *goals, *map_legend(), *crosses]
        figure.legend(handles=entries, loc="outside lower center", ncols=8)
    return figure


def _draw_episode(axes: Axes, episode: Episode) -> LineCollection:
    draw_start(axes, tuple(episode.positions[0]))
    for goal in episode.goals_reached:
        draw_goal(axes, tuple(goal))
    draw_goal(axes, tuple(episode.goals[-1]), reached=False)
    segments = np.stack([episode.positions[:-1], episode.positions[1:]], axis=1)
    line = LineCollection(
        list(segments),
        cmap=BATTERY_COLORS,
        norm=Normalize(0, BATTERY_FULL),
        linewidths=1.6,
        capstyle="round",
        zorder=3,
    )
    line.set_array(episode.battery[:-1])
    axes.add_collection(line, autolim=False)
    return line


def _draw_violations(
    axes: Axes, episode: Episode, names: Sequence[str], colors: Mapping[str, str]
) -> str:
    """Mark the steps that broke a constraint; return what the title says of them."""
    for i, (name, mark) in enumerate(zip(names, cycle(_MARKS), strict=False)):
        at = episode.positions[1:][episode.costs[:, i] > 0]
        axes.plot(*at.T, mark, color=colors[name], markersize=6, markeredgewidth=1.3, zorder=6)
    count = int(episode.costs.sum())
    return f" · {count} violations" if count else ""
