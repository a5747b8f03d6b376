"""One panel of the flow's stages: the density in action space, the sets, the executed action."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from numpy.typing import NDArray
from torch import Tensor

from cnfp_torchrl.visual.colors import INK, MUTED
from cnfp_torchrl.visual.density import (
    CURVE,
    FILL,
    draw_grid,
    draw_rug,
    draw_samples,
    draw_scored_samples,
)
from cnfp_torchrl.visual.outlines import Line, View, interval, region_outline, set_outline
from cnfp_torchrl.visual.snapshot import FlowSnapshot

Grid = tuple[Tensor, Tensor]
"""Actions of a grid of base samples after a stage, and their log-densities."""

_TRACKS = 60
_NOT_APPLIED = (0, (1.2, 1.8))


@dataclass(frozen=True)
class PanelStyle:
    """What all panels of one figure share.

    Args:
        view: limits of the action axes.
        scale: of the log-density's colors.
        colors: of the constraints.
        outlines: of each of the region's sets, the action bounds first.
    """

    view: View
    scale: Normalize
    colors: Mapping[str, str]
    outlines: Sequence[list[Line]]


def set_outlines(snapshot: FlowSnapshot, view: View) -> list[list[Line]]:
    """Return the outlines of each of a region's sets, or of their shadows in more dimensions.

    Shadows are those of the part within the action bounds, which the shadow of a half-space alone
    would not show, and dropped sets, of which no inner point is known, have none. In one dimension
    there is nothing to draw.
    """
    if snapshot.dim == 1:
        return [[] for _ in snapshot.region.sets]
    bounds = [region_outline(snapshot.region, (0,))]
    if snapshot.dim == 2:
        return [bounds, *(set_outline(each, view) for each in snapshot.region.sets[1:])]
    indices = range(1, len(snapshot.region.sets))
    shadows = [
        [region_outline(snapshot.region, (0, k))] if snapshot.is_active(k) else [] for k in indices
    ]
    return [bounds, *shadows]


def draw_plane(
    axes: Axes, snapshot: FlowSnapshot, index: int, grid: Grid | None, style: PanelStyle
) -> None:
    """Draw a stage in the plane of the first two action components.

    Args:
        axes: an empty panel.
        snapshot: of dimension 2 or more.
        index: of the stage.
        grid: of `cnfp_torchrl.visual.density.grid_latents`; None colors the samples instead.
        style: shared by all panels.
    """
    stage = snapshot.stages[index]
    samples, broken = stage.samples[:, :2], snapshot.outside(index)
    if grid is None:
        draw_scored_samples(axes, samples, stage.log_density, style.scale, broken)
    else:
        draw_grid(axes, *grid, style.scale)
        draw_samples(axes, samples, broken)
    if index > 0:
        before = snapshot.stages[index - 1].samples[:_TRACKS, :2].numpy()
        tracks = np.stack([before, samples[:_TRACKS].numpy()], axis=1)
        lines = LineCollection(list(tracks), colors=INK, linewidths=0.5, alpha=0.45, zorder=2)
        axes.add_collection(lines, autolim=False)
    _draw_sets(axes, snapshot, index, style)
    draw_path(axes, snapshot.path()[: index + 1, :2].numpy())
    axes.set_xlim(style.view[0], style.view[1])
    axes.set_ylim(style.view[2], style.view[3])
    axes.set_aspect("equal")


def draw_line(
    axes: Axes, snapshot: FlowSnapshot, index: int, grid: Grid, top: float, style: PanelStyle
) -> None:
    """Draw a stage on the line: the density's curve over the one action component.

    Below it stand the samples, and a bar for each constraint's interval.

    Args:
        axes: an empty panel.
        snapshot: of dimension 1.
        index: of the stage.
        grid: of `cnfp_torchrl.visual.density.grid_latents`.
        top: the highest density of all panels that share the axis.
        style: shared by all panels.
    """
    stage = snapshot.stages[index]
    x, density = grid[0][:, 0].numpy(), grid[1].exp().numpy()
    axes.fill_between(x, density, color=FILL, zorder=1)
    axes.plot(x, density, color=CURVE, linewidth=1.4, zorder=2, label="density")
    draw_rug(axes, stage.samples, -0.03 * top, snapshot.outside(index))
    for k in range(1, len(snapshot.region.sets)):
        if snapshot.is_active(k):
            level = -0.06 * top * (1 + k)
            ends = interval(snapshot.region, (k,))
            axes.plot(
                ends, (level, level), solid_capstyle="butt", **_set_style(snapshot, index, k, style)
            )
    for applied, color in (((0,), MUTED), (stage.applied, INK)):
        for end in interval(snapshot.region, applied):
            axes.axvline(end, color=color, linewidth=1.0, zorder=4)
    path = snapshot.path()[: index + 1].numpy()
    draw_path(axes, np.concatenate([path, np.zeros_like(path)], axis=-1))
    axes.set_xlim(style.view[0], style.view[1])
    axes.set_ylim(-0.06 * top * (2 + len(snapshot.constraint_names)), 1.05 * top)
    axes.set_yticks([tick for tick in axes.get_yticks() if 0 <= tick <= top])


def draw_path(axes: Axes, path: NDArray[np.float32]) -> None:
    """Draw where one action, ``(stages, 2)``, was after each stage so far, and where it is now."""
    if len(path) > 1:
        axes.plot(*path.T, "-", color=INK, linewidth=1.1, zorder=7)
        axes.plot(*path[:-1].T, "o", color="white", mec=INK, mew=0.9, markersize=3.5, zorder=8)
    axes.plot(*path[-1:].T, "D", color=INK, mec="white", mew=0.9, markersize=6, zorder=9)


def _draw_sets(axes: Axes, snapshot: FlowSnapshot, index: int, style: PanelStyle) -> None:
    bounds, *sets = style.outlines
    for k, lines in enumerate(sets, start=1):
        _draw_outline(axes, lines, zorder=5, **_set_style(snapshot, index, k, style))
    _draw_outline(axes, bounds, color=MUTED, linewidth=0.8, zorder=4)
    so_far = region_outline(snapshot.region, snapshot.stages[index].applied)
    _draw_outline(axes, [so_far], color=INK, linewidth=1.0, zorder=6, label="set so far")


def _set_style(snapshot: FlowSnapshot, index: int, k: int, style: PanelStyle) -> dict[str, Any]:
    """Return a constraint's line: wide where it is applied now, dotted where it does not hold."""
    applied = snapshot.stages[index].applied
    holds = k in applied and snapshot.is_active(k)
    name = snapshot.constraint_names[k - 1]
    return {
        "color": style.colors[name],
        "linewidth": 2.4 if k == applied[-1] else 1.3,
        "linestyle": "-" if holds else _NOT_APPLIED,
        "label": name,
    }


def _draw_outline(axes: Axes, lines: list[Line], **style: Any) -> None:
    for line in lines:
        axes.plot(*line.T, **style)
