"""A flow policy in one state: the map, the base, and what each stage makes of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cnfp_torchrl.tasks.point_nav import Layout
from cnfp_torchrl.visual.arena import agent_entry, goal_entry
from cnfp_torchrl.visual.base_panel import draw_base
from cnfp_torchrl.visual.canvas import house_style, new_figure
from cnfp_torchrl.visual.colors import INK, MUTED, constraint_colors
from cnfp_torchrl.visual.density import BREAKS, COLORS, density_scale, grid_latents
from cnfp_torchrl.visual.map_panel import draw_moves
from cnfp_torchrl.visual.outlines import View
from cnfp_torchrl.visual.snapshot import FlowSnapshot
from cnfp_torchrl.visual.stage_panels import Grid, PanelStyle, draw_line, draw_plane, set_outlines

_COLUMNS = 5


def flow_stages(
    snapshot: FlowSnapshot,
    *,
    layout: Layout | None = None,
    colors: Mapping[str, str] | None = None,
    title: str = "Flow stages",
) -> Figure:
    """Draw a flow policy in one state, its stages in order of application.

    In one and two dimensions the density is exact, from a grid of base samples pushed through the
    stages with its log-determinants. In more, the samples carry their exact log-density, projected
    on the first two components, and outlines are those of shadows.

    Args:
        snapshot: the policy in the state.
        layout: the map, for states of point navigation; None leaves its panel out.
        colors: of the constraints; None chooses them by name.
        title: above the panels.
    """
    colors = dict(colors or constraint_colors(snapshot.constraint_names))
    grids = stage_grids(snapshot)
    view = _view(snapshot)
    style = PanelStyle(view, density_scale(snapshot), colors, set_outlines(snapshot, view))
    first = 0 if layout is None else 1
    panels = first + 1 + len(snapshot.stages)
    rows = -(-panels // _COLUMNS)
    columns = -(-panels // rows)
    with house_style():
        figure = new_figure(2.75 * columns + 0.9, 3.15 * rows + 0.9)
        if snapshot.dim > 2:
            title += f"\nfirst two of {snapshot.dim} action components, outlines are shadows"
        figure.suptitle(title)
        axes = [figure.add_subplot(rows, columns, i + 1) for i in range(panels)]
        if layout is not None:
            draw_moves(axes[0], snapshot, layout, colors)
        draw_base(axes[first], snapshot, style.scale)
        axes[first].set_title("base\nz ~ N(μ, σ²)")
        _name_axes(axes[first], snapshot.dim, "z", leftmost=True)
        for i, panel in enumerate(axes[first + 1 :]):
            if snapshot.dim == 1:
                assert grids is not None
                draw_line(panel, snapshot, i, grids[i], _top(grids), style)
            else:
                draw_plane(panel, snapshot, i, None if grids is None else grids[i], style)
            panel.set_title(_stage_title(snapshot, i))
            _name_axes(panel, snapshot.dim, "a", leftmost=i == 0)
        if snapshot.dim > 1:
            mapping = ScalarMappable(style.scale, COLORS)
            bar = figure.colorbar(mapping, ax=axes, shrink=0.75, aspect=28)
            bar.set_label("log-density (nats)")
            bar.outline.set_visible(False)
        entries = _legend(snapshot, colors, with_map=layout is not None)
        width = 2 * columns
        figure.legend(handles=entries, loc="outside lower center", ncols=min(len(entries), width))
    return figure


def stage_grids(snapshot: FlowSnapshot) -> list[Grid] | None:
    """Return a grid of base samples after each stage; None in more than two dimensions."""
    if snapshot.dim > 2:
        return None
    grid = grid_latents(snapshot)
    points, log_density = snapshot.through_stages(grid.reshape(-1, snapshot.dim))
    return [
        (each.reshape(grid.shape), density.reshape(grid.shape[:-1]))
        for each, density in zip(points, log_density, strict=True)
    ]


def _top(grids: list[Grid]) -> float:
    """Return the density that the axis ends at, not the spike that a saturated flow can have."""
    density = torch.cat([log_density for _, log_density in grids]).double().exp()
    return max(float(density[density.isfinite()].quantile(0.98)), 1e-3)


def _view(snapshot: FlowSnapshot) -> View:
    """Return limits that hold the action bounds and every sample of every stage."""
    bounds = snapshot.region.bounds
    points = torch.cat([bounds.low[None], bounds.high[None], *(s.samples for s in snapshot.stages)])
    low, high = points[:, :2].amin(0).double(), points[:, :2].amax(0).double()
    # A square, so that all panels are of one shape.
    middle, reach = (low + high) / 2, 0.58 * (high - low).max()
    lowest, highest = (middle - reach).tolist(), (middle + reach).tolist()
    return lowest[0], highest[0], lowest[-1], highest[-1]


def _name_axes(axes: Axes, dim: int, symbol: str, *, leftmost: bool) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel(f"${symbol}_1$" if dim > 1 else f"${symbol}$")
    if leftmost:
        axes.set_ylabel(f"${symbol}_2$" if dim > 1 else "density")


def _stage_title(snapshot: FlowSnapshot, index: int) -> str:
    stage = snapshot.stages[index]
    name = "action bounds" if stage.applied[-1] == 0 else stage.name
    head = f"stage {index + 1}: {name}"
    if not stage.active:
        head += " (dropped here)" if snapshot.is_safe else " (cannot hold here)"
    said = "break a constraint" if index + 1 == len(snapshot.stages) else "outside the set so far"
    return f"{head}\n{int(snapshot.outside(index).sum())} of {len(stage.samples)} {said}"


def _legend(snapshot: FlowSnapshot, colors: Mapping[str, str], *, with_map: bool) -> list[Line2D]:
    entries = [agent_entry(), goal_entry("goal", reached=False)] if with_map else []
    entries += [
        Line2D([], [], color=colors[name], linewidth=2.4, label=f"{name} set")
        for name in snapshot.constraint_names
    ]
    entries += [
        Line2D([], [], color=INK, linewidth=1, label="set so far"),
        Line2D([], [], color=MUTED, linewidth=0.8, label="action bounds"),
        Line2D([], [], color=INK, marker=".", markersize=4, linestyle="none", label="samples"),
    ]
    if any(bool(snapshot.outside(i).any()) for i in range(len(snapshot.stages))):
        outside: dict[str, Any] = {"color": BREAKS, "marker": ".", "linestyle": "none"}
        entries.append(Line2D([], [], label="samples outside", **outside))
    if len(snapshot.stages) > 1 and snapshot.dim > 1:
        entries.append(
            Line2D([], [], color=INK, lw=0.5, alpha=0.6, label="way from the stage before")
        )
    mark: dict[str, Any] = {
        "marker": "D",
        "markerfacecolor": INK,
        "markeredgecolor": "white",
        "markersize": 7,
    }
    said = "executed action" if snapshot.followed == 0 else "action moved farthest"
    entries.append(Line2D([], [], label=said, linestyle="none", **mark))
    return entries
