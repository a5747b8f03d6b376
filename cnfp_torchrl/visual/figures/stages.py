"""A flow policy in one state: the map, the base, and what each stage makes of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from torch import Tensor
from torchrl.envs import EnvBase

from cnfp_torchrl.visual.colors import INK, MUTED
from cnfp_torchrl.visual.figures.canvas import house_style, new_figure
from cnfp_torchrl.visual.figures.map import AGENT, draw_moves, goal_entry, legend_entry
from cnfp_torchrl.visual.outlines import Line
from cnfp_torchrl.visual.scene import (
    PRINTED,
    Detail,
    Scene,
    base_density,
    density_limits,
)
from cnfp_torchrl.visual.setting import Setting
from cnfp_torchrl.visual.snapshot import FlowSnapshot

DENSITY = LinearSegmentedColormap.from_list(
    "density", ["#FFFFFF", "#F0ECF8", "#DAD1EC", "#BFB0DE", "#A18ECE", "#8570BC"]
)
"""White where rare, and light enough for samples and outlines to stand out everywhere."""

FILL, CURVE = "#DAD1EC", "#7A62B3"

OUTSIDE = "#B80F0A"
"""Samples outside the set so far; after the last stage, those that break any constraint."""

SPREAD = 3.2
"""How many standard deviations of the base its density is drawn over."""

_COLUMNS = 5
_TRACKS = 60
_NOT_APPLIED = (0, (1.2, 1.8))


def flow_stages(
    snapshot: FlowSnapshot,
    *,
    env: EnvBase | None = None,
    colors: Mapping[str, str] | None = None,
    title: str = "Flow stages",
    detail: Detail = PRINTED,
) -> Figure:
    """Draw a flow policy in one state, its stages in order of application.

    In one and two dimensions the density is exact, by the flow's inverse on a grid of actions. In
    more, the samples carry their exact log-density, projected on the first two components, and
    outlines are those of shadows.

    Args:
        snapshot: The policy in the state.
        env: The environment, which names the components of the action and may have a map; None:
            neither.
        colors: The colors of the constraints; None chooses them by name.
        title: The title above the panels.
        detail: The fineness of what is drawn.
    """
    setting = Setting.of(snapshot.head, env).holding(snapshot)
    scene = Scene(setting, snapshot, detail)
    colors = dict(colors or setting.colors)
    limits = Normalize(*density_limits(snapshot))
    first = 0 if setting.view.map is None else 1
    panels = first + 1 + len(snapshot.stages)
    rows = -(-panels // _COLUMNS)
    columns = -(-panels // rows)
    with house_style():
        figure = new_figure(2.75 * columns + 0.9, 3.15 * rows + 0.9)
        if snapshot.dim > 2:
            title += f"\nfirst two of {snapshot.dim} action components, outlines are shadows"
        figure.suptitle(title)
        axes = [figure.add_subplot(rows, columns, i + 1) for i in range(panels)]
        if first:
            draw_moves(axes[0], scene, colors)
        draw_base(axes[first], snapshot, limits, detail.cells)
        axes[first].set_title("base\nz ~ N(μ, σ²)")
        # What the base draws has no unit.
        _name_axes(axes[first], [f"z of {part.name}" for part in setting.components])
        for i, panel in enumerate(axes[first + 1 :]):
            if snapshot.dim == 1:
                _draw_line(panel, scene, i, colors)
            else:
                _draw_plane(panel, scene, i, colors, limits)
            panel.set_title(_stage_title(snapshot, i))
            _name_axes(panel, [part.title for part in setting.components], leftmost=i == 0)
        if snapshot.dim > 1:
            bar = figure.colorbar(ScalarMappable(limits, DENSITY), ax=axes, shrink=0.75, aspect=28)
            bar.set_label("log-density (nats)")
            bar.outline.set_visible(False)
        entries = _legend(scene, colors)
        figure.legend(
            handles=entries, loc="outside lower center", ncols=min(len(entries), 2 * columns)
        )
    return figure


def draw_base(axes: Axes, snapshot: FlowSnapshot, limits: Normalize, cells: int) -> None:
    """Draw the Gaussian base, in one or in the first two of its components.

    Args:
        axes: An empty panel.
        snapshot: The policy in a state.
        limits: The limits of the log-density's colors.
        cells: The number of cells of the density's grid along each axis.
    """
    if snapshot.dim == 1:
        latents, log_density = base_density(snapshot, SPREAD, 4 * cells)
        density = log_density.exp().numpy()
        top = float(density.max())
        _draw_curve(axes, np.stack([latents[:, 0].numpy(), density], axis=-1))
        _draw_rug(axes, snapshot.latents, -0.03 * top)
        _draw_path(axes, np.array([[snapshot.latents[snapshot.followed, 0], 0.0]]))
        axes.set_ylim(-0.1 * top, 1.05 * top)
        return
    if snapshot.dim == 2:
        latents, log_density = base_density(snapshot, SPREAD, cells)
        draw_density(axes, latents, log_density, limits)
        draw_samples(axes, snapshot.latents)
    else:
        _draw_scored(axes, snapshot.latents[:, :2], snapshot.latent_log_density, limits)
    followed = snapshot.latents[snapshot.followed, :2] - snapshot.loc[:2]
    _draw_path(axes, (snapshot.loc[:2] + followed).unsqueeze(0).numpy())
    reach = max(SPREAD * float(snapshot.scale[:2].max()), 1.06 * float(followed.abs().max()))
    x, y = snapshot.loc[:2].tolist()
    axes.set_xlim(x - reach, x + reach)
    axes.set_ylim(y - reach, y + reach)
    axes.set_aspect("equal")


def draw_density(axes: Axes, cells: Tensor, log_density: Tensor, limits: Normalize) -> None:
    """Color the cells of a grid ``(rows, columns, 2)`` by their log-density ``(rows, columns)``."""
    x, y = cells[0, :, 0].numpy(), cells[:, 0, 1].numpy()
    values = np.clip(log_density.nan_to_num(neginf=-1e6).numpy(), limits.vmin, limits.vmax)
    axes.pcolormesh(x, y, values, cmap=DENSITY, norm=limits, shading="nearest", zorder=1)


def draw_samples(axes: Axes, samples: Tensor, outside: Tensor | None = None) -> None:
    """Draw samples ``(n, 2)`` as dots, those that are outside in a color of warning."""
    inside = slice(None) if outside is None else ~outside
    dots: dict[str, Any] = {"marker": ".", "linestyle": "none", "mew": 0, "zorder": 3}
    good = samples[inside].numpy().T
    axes.plot(*good, color=INK, markersize=2.4, alpha=0.7, label="samples", **dots)
    if outside is not None:
        bad = samples[outside].numpy().T
        axes.plot(*bad, color=OUTSIDE, markersize=3.2, alpha=0.9, label="outside", **dots)


def _draw_plane(
    axes: Axes, scene: Scene, index: int, colors: Mapping[str, str], limits: Normalize
) -> None:
    """Draw a stage in the plane of the first two action components."""
    snapshot, plane = scene.snapshot, (0, 1)
    stage, outside = snapshot.stages[index], snapshot.outside(index)
    if scene.log_density is None:
        _draw_scored(axes, stage.samples[:, :2], stage.log_density, limits, outside)
    else:
        draw_density(axes, scene.actions, scene.log_density[index], limits)
        draw_samples(axes, stage.samples, outside)
    tracks = LineCollection(
        list(scene.tracks(index, plane, _TRACKS)), colors=INK, linewidths=0.5, alpha=0.45, zorder=2
    )
    axes.add_collection(tracks, autolim=False)
    for k in range(1, len(snapshot.region.sets)):
        lines = scene.set_lines(k, plane) or scene.dropped_lines(k, plane)
        _draw_lines(axes, lines, zorder=5, **_set_style(snapshot, index, k, colors))
    _draw_lines(axes, scene.set_lines(0, plane), color=MUTED, linewidth=0.8, zorder=4)
    so_far: dict[str, Any] = {"color": INK, "linewidth": 1.0, "zorder": 6, "label": "set so far"}
    _draw_lines(axes, scene.allowed_lines(index, plane), **so_far)
    _draw_path(axes, scene.path(index, plane))
    first, second = scene.setting.limits[:2]
    axes.set_xlim(*first)
    axes.set_ylim(*second)
    axes.set_box_aspect(1)


def _draw_line(axes: Axes, scene: Scene, index: int, colors: Mapping[str, str]) -> None:
    """Draw a stage on the line: the density's curve over the one action component.

    Below it stand the samples, and a bar for each constraint's interval.
    """
    snapshot = scene.snapshot
    assert scene.log_density is not None
    density = scene.log_density.double().exp().numpy()
    # The axis ends here, and not at the spike that a saturated flow can have.
    top = max(float(np.quantile(density[np.isfinite(density)], 0.98)), 1e-3)
    _draw_curve(axes, np.stack([scene.actions[:, 0].numpy(), density[index]], axis=-1))
    _draw_rug(axes, snapshot.stages[index].samples, -0.03 * top, snapshot.outside(index))
    for k in range(1, len(snapshot.region.sets)):
        if (ends := scene.interval((k,))) is not None:
            level = -0.06 * top * (1 + k)
            style = _set_style(snapshot, index, k, colors)
            axes.plot(ends, (level, level), solid_capstyle="butt", **style)
    for applied, color in (((0,), MUTED), (snapshot.stages[index].applied, INK)):
        for end in scene.interval(applied) or scene.setting.limits[0]:
            axes.axvline(end, color=color, linewidth=1.0, zorder=4)
    path = scene.path(index, (0,))
    _draw_path(axes, np.concatenate([path, np.zeros_like(path)], axis=-1))
    axes.set_xlim(*scene.setting.limits[0])
    axes.set_ylim(-0.06 * top * (2 + len(snapshot.constraint_names)), 1.05 * top)
    axes.set_yticks([tick for tick in axes.get_yticks() if 0 <= tick <= top])


def _draw_curve(axes: Axes, curve: Line) -> None:
    axes.fill_between(*curve.T, color=FILL, zorder=1)
    axes.plot(*curve.T, color=CURVE, linewidth=1.4, zorder=2, label="density")


def _draw_scored(
    axes: Axes,
    samples: Tensor,
    log_density: Tensor,
    limits: Normalize,
    outside: Tensor | None = None,
) -> None:
    """Draw samples ``(n, 2)`` colored by their log-density ``(n,)``."""
    inside = slice(None) if outside is None else ~outside
    x, y = samples[inside].numpy().T
    colors = DENSITY(limits(log_density[inside].numpy()))
    axes.scatter(x, y, c=colors, s=8, linewidths=0.3, edgecolors=MUTED, zorder=3)
    if outside is not None:
        axes.plot(*samples[outside].numpy().T, ".", color=OUTSIDE, markersize=4, mew=0, zorder=3)


def _draw_rug(axes: Axes, samples: Tensor, level: float, outside: Tensor | None = None) -> None:
    """Draw samples ``(n, 1)`` of one component as ticks at a level."""
    parts = [(slice(None), INK)] if outside is None else [(~outside, INK), (outside, OUTSIDE)]
    for chosen, color in parts:
        at = samples[chosen, 0].numpy()
        axes.plot(at, np.full_like(at, level), "|", color=color, markersize=5, alpha=0.15)


def _draw_path(axes: Axes, path: NDArray[Any]) -> None:
    """Draw where one action, ``(stages, 2)``, was after each stage so far, and where it is now."""
    if len(path) > 1:
        axes.plot(*path.T, "-", color=INK, linewidth=1.1, zorder=7)
        axes.plot(*path[:-1].T, "o", color="white", mec=INK, mew=0.9, markersize=3.5, zorder=8)
    axes.plot(*path[-1:].T, "D", color=INK, mec="white", mew=0.9, markersize=6, zorder=9)


def _set_style(
    snapshot: FlowSnapshot, index: int, k: int, colors: Mapping[str, str]
) -> dict[str, Any]:
    """Return a constraint's line: wide where it is applied now, dotted where it does not hold."""
    applied = snapshot.stages[index].applied
    holds = k in applied and snapshot.is_active(k)
    name = snapshot.constraint_names[k - 1]
    return {
        "color": colors[name],
        "linewidth": 2.4 if k == applied[-1] else 1.3,
        "linestyle": "-" if holds else _NOT_APPLIED,
        "label": name,
    }


def _draw_lines(axes: Axes, lines: list[Line], **style: Any) -> None:
    for line in lines:
        axes.plot(*line.T, **style)


def _name_axes(axes: Axes, titles: Sequence[str], *, leftmost: bool = True) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel(titles[0])
    if leftmost:
        axes.set_ylabel(titles[1] if len(titles) > 1 else "density")


def _stage_title(snapshot: FlowSnapshot, index: int) -> str:
    stage = snapshot.stages[index]
    name = "action bounds" if stage.applied[-1] == 0 else stage.name
    head = f"stage {index + 1}: {name}"
    if not stage.active and not snapshot.is_safe:
        head += " (cannot hold here)"
    elif not stage.active:
        head += (
            " (dropped here)" if not snapshot.is_active(stage.applied[-1]) else " (relaxed here)"
        )
    fault = "break a constraint" if index + 1 == len(snapshot.stages) else "outside the set so far"
    return f"{head}\n{int(snapshot.outside(index).sum())} of {len(stage.samples)} {fault}"


def _legend(scene: Scene, colors: Mapping[str, str]) -> list[Line2D]:
    snapshot, plane = scene.snapshot, scene.setting.view.map
    entries = [] if plane is None else [legend_entry("agent", **AGENT)]
    if plane is not None and scene.setting.view.goal(snapshot.state) is not None:
        entries.append(goal_entry("goal", reached=False))
    entries += [
        Line2D([], [], color=colors[name], linewidth=2.4, label=f"{name} set")
        for name in snapshot.constraint_names
    ]
    entries += [
        Line2D([], [], color=INK, linewidth=1, label="set so far"),
        Line2D([], [], color=MUTED, linewidth=0.8, label="action bounds"),
        legend_entry("samples", color=INK, marker=".", markersize=4),
    ]
    if any(bool(snapshot.outside(i).any()) for i in range(len(snapshot.stages))):
        entries.append(legend_entry("samples outside", color=OUTSIDE, marker="."))
    if len(snapshot.stages) > 1 and snapshot.dim > 1:
        entries.append(
            Line2D([], [], color=INK, lw=0.5, alpha=0.6, label="way from the stage before")
        )
    executed = "executed action" if snapshot.followed == 0 else "action moved farthest"
    mark: dict[str, Any] = {"marker": "D", "markerfacecolor": INK, "markeredgecolor": "white"}
    entries.append(legend_entry(executed, markersize=7, **mark))
    return entries
