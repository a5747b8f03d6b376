"""Episodes on a task's map."""

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
from numpy.typing import NDArray
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from cnfp_torchrl.envs import TaskView, find_task_view
from cnfp_torchrl.keys import COST_KEY, REWARD_KEY
from cnfp_torchrl.visual.colors import INK, constraint_colors
from cnfp_torchrl.visual.figures.canvas import house_style, new_figure
from cnfp_torchrl.visual.figures.map import (
    START,
    axis_label,
    draw_goal,
    draw_map,
    goal_entry,
    legend_entry,
    map_legend,
)

LEVELS = LinearSegmentedColormap.from_list("levels", ["#2B0B3F", "#8C2981", "#E8543E", "#FDB42F"])
"""Dark when low, light when high: readable in gray and with any color vision."""

_COLUMNS = 3
_MARKS = ("x", "+", "1", "2")


@dataclass(frozen=True)
class Episode:
    """What happened to one agent, step by step.

    Args:
        positions: The positions on the map, ``(steps + 1, 2)``.
        levels: The first of the task's series, before each step and at the end, ``(steps + 1,)``;
            None for a task without one.
        goals: The goals on the map, ``(steps + 1, 2)``; None for a task without goals.
        rewards: The rewards, ``(steps,)``.
        costs: The indicators, ``(steps, K)``; K = 0 where the environment counts nothing.
    """

    positions: NDArray[np.float32]
    levels: NDArray[np.float64] | None
    goals: NDArray[np.float32] | None
    rewards: NDArray[np.float32]
    costs: NDArray[np.float32]

    @property
    def goals_reached(self) -> NDArray[np.float32]:
        """The goals reached, in order, ``(reached, 2)``: those that were replaced by another."""
        if self.goals is None:
            return np.zeros((0, 2), dtype=np.float32)
        replaced = (self.goals[1:] != self.goals[:-1]).any(-1)
        return self.goals[:-1][replaced]


@torch.no_grad()
def record_episodes(
    env: EnvBase, policy: TensorDictModuleBase, *, max_steps: int = 1000
) -> list[Episode]:
    """Run one episode for each batch element of an environment whose task has a map.

    Args:
        env: The environment, with any transforms, ``(batch,)``.
        policy: The policy, which writes ``action``; draws by the exploration type in force.
        max_steps: The number of steps after which episodes are cut.
    """
    view = find_task_view(env)
    rollout = env.rollout(max_steps, policy, break_when_any_done=True).cpu()
    after = rollout.get("next")
    shared = [key for key in after.keys() if key in rollout.keys()]  # noqa: SIM118
    states = torch.cat([rollout.select(*shared), after.select(*shared)[:, -1:]], dim=1)
    positions, goals = view.position(states), view.goal(states)
    levels = view.series_values(states)[view.series[0].name] if view.series else None
    rewards = after[REWARD_KEY].squeeze(-1)
    costs = after.get(COST_KEY, rewards.new_zeros((*rewards.shape, 0)))
    return [
        Episode(
            positions=positions[i].numpy(),
            levels=None if levels is None else levels[i].numpy(),
            goals=None if goals is None else goals[i].numpy(),
            rewards=rewards[i].numpy(),
            costs=costs[i].numpy(),
        )
        for i in range(len(rollout))
    ]


def trajectories(
    view: TaskView,
    episodes: Sequence[Episode],
    constraint_names: Sequence[str] = (),
    *,
    colors: Mapping[str, str] | None = None,
    title: str = "Episodes",
) -> Figure:
    """Draw each episode on a map of its own, the line colored by the first of the task's series.

    Where a violating step ends stands a cross in the constraint's color.

    Args:
        view: The view of a task with a map.
        episodes: The episodes, one for each panel.
        constraint_names: The names of the columns of the episodes' costs.
        colors: The colors of the constraints; None chooses them by name.
        title: The title above the panels.
    """
    plane = view.map
    assert plane is not None
    colors = dict(colors or constraint_colors(constraint_names))
    columns = min(len(episodes), _COLUMNS)
    rows = -(-len(episodes) // columns)
    scale = _scale(view, episodes)
    with house_style():
        figure = new_figure(3.0 * columns + 0.9, 3.1 * rows + 0.8)
        figure.suptitle(title)
        panels = []
        line = None
        for i, episode in enumerate(episodes):
            axes = figure.add_subplot(rows, columns, i + 1)
            panels.append(axes)
            draw_map(axes, plane, labels=False)
            if i % columns == 0:
                axes.set_ylabel(axis_label(plane, 1))
            if i + columns >= len(episodes):
                axes.set_xlabel(axis_label(plane, 0))
            line = _draw_episode(axes, episode, scale)
            counted = _draw_violations(axes, episode, constraint_names, colors)
            axes.set_title(_title(episode, counted))
        if view.series and line is not None:
            series = view.series[0]
            label = f"{series.name} ({series.unit})" if series.unit else series.name
            bar = figure.colorbar(line, ax=panels, shrink=0.7, aspect=30, label=label)
            bar.outline.set_visible(False)
            if series.threshold is not None:
                bar.ax.axhline(series.threshold, color=INK, linewidth=1.2)
        entries = [legend_entry("start", **START)]
        if any(episode.goals is not None for episode in episodes):
            entries += [goal_entry("goal reached"), goal_entry("last goal", reached=False)]
        entries += map_legend(view)
        entries += [
            legend_entry(f"breaks {name}", marker=mark, color=colors[name])
            for i, (name, mark) in enumerate(zip(constraint_names, cycle(_MARKS), strict=False))
            if any(episode.costs[:, i].any() for episode in episodes)
        ]
        figure.legend(handles=entries, loc="outside lower center", ncols=8)
    return figure


def _scale(view: TaskView, episodes: Sequence[Episode]) -> Normalize | None:
    """Return the color scale of the first series, by its limits or by what there was of it."""
    if not view.series:
        return None
    if view.series[0].limits is not None:
        return Normalize(*view.series[0].limits)
    levels = np.concatenate([episode.levels for episode in episodes if episode.levels is not None])
    return Normalize(float(levels.min()), float(levels.max()))


def _draw_episode(axes: Axes, episode: Episode, scale: Normalize | None) -> LineCollection:
    axes.plot(*episode.positions[0], zorder=5, **START)
    for goal in episode.goals_reached:
        draw_goal(axes, tuple(goal))
    if episode.goals is not None:
        draw_goal(axes, tuple(episode.goals[-1]), reached=False)
    segments = np.stack([episode.positions[:-1], episode.positions[1:]], axis=1)
    line = LineCollection(list(segments), linewidths=1.6, capstyle="round", zorder=3)
    if scale is None or episode.levels is None:
        line.set_color(INK)
    else:
        line.set(cmap=LEVELS, norm=scale, array=episode.levels[:-1])
    axes.add_collection(line, autolim=False)
    return line


def _title(episode: Episode, violations: str) -> str:
    title = f"return {float(episode.rewards.sum()):.1f}"
    if episode.goals is not None:
        reached = len(episode.goals_reached)
        title += " · 1 goal" if reached == 1 else f" · {reached} goals"
    # A true minus sign, as on the axes.
    return f"{title}{violations}".replace("-", "\N{MINUS SIGN}")


def _draw_violations(
    axes: Axes, episode: Episode, names: Sequence[str], colors: Mapping[str, str]
) -> str:
    """Mark the steps that broke a constraint; return what the title says of them."""
    for i, (name, mark) in enumerate(zip(names, cycle(_MARKS), strict=False)):
        at = episode.positions[1:][episode.costs[:, i] > 0]
        axes.plot(*at.T, mark, color=colors[name], markersize=6, markeredgewidth=1.3, zorder=6)
    count = int(episode.costs.sum())
    return f" · {count} violations" if count else ""
