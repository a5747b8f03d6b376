"""The figure of an audit: numbers by constraint, and the states that speak most against one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from cnfp_torchrl.audit import (
    TOGETHER,
    AuditReport,
    ConstraintMetrics,
    Quantiles,
    Share,
    WorstState,
)
from cnfp_torchrl.visual.colors import INK, MUTED, constraint_colors
from cnfp_torchrl.visual.figures.canvas import house_style, new_figure, save_png
from cnfp_torchrl.visual.outlines import region_outline, set_outline

_FLAW = "#B80F0A"

_MARKS: dict[str, dict[str, Any]] = {
    "violates, outside the set": {"marker": "x", "color": "#9A9A9A", "markersize": 4, "mew": 0.8},
    "allowed, left out": {"marker": ".", "color": "#8FCFBB", "markersize": 7, "mew": 0},
    "allowed, in the set": {"marker": ".", "color": "#1F6B58", "markersize": 6, "mew": 0},
    "leads to where it gives way": {"marker": "s", "color": "#E69F00", "markersize": 4, "mew": 0},
    "violates, in the set": {"marker": "X", "color": _FLAW, "markersize": 6, "mew": 0},
}

_MOST_SCENES = 4
_MOST_FLAWS = 6


def audit_figure(report: AuditReport) -> Figure:
    """Draw an audit.

    The upper row holds the numbers by constraint; bars come from each source of states. The lower
    row, for actions in the plane, shows for each constraint the state that speaks most against its
    set: every action tried there.

    Args:
        report: of `cnfp_torchrl.audit.audit`.
    """
    colors = constraint_colors(report.order) | {TOGETHER: INK}
    scenes = [scene for scene in report.worst_states if scene.actions.shape[-1] == 2][:_MOST_SCENES]
    with house_style():
        figure = new_figure(13.0, 7.4 if scenes else 3.4)
        verdict = f"{len(report.flaws)} flaws" if report.flaws else "no flaw found"
        figure.suptitle(f"Audit of {report.subject['environment']}: {verdict}")
        upper, *lower = figure.subfigures(2 if scenes else 1, 1, squeeze=False)[:, 0]
        _draw_numbers(upper.subplots(1, 4), report, colors)
        upper.legend(
            handles=_source_entries(list(report.sources)), loc="outside lower center", ncols=2
        )
        for part in lower:
            *panels, remarks = part.subplots(1, len(scenes) + 1, squeeze=False)[0]
            for axes, scene in zip(panels, scenes, strict=True):
                _draw_scene(axes, scene, report.order, colors)
            _write_remarks(remarks, report)
    return figure


def save_audit(report: AuditReport, path: Path) -> Path:
    """Draw an audit into a PNG file and return where it is."""
    return save_png(audit_figure(report), path)


def _draw_numbers(panels: Sequence[Axes], report: AuditReport, colors: Mapping[str, str]) -> None:
    names = [*report.order, TOGETHER]
    titles = (
        "unsound\n% of actions in the set",
        "coverage\n% of what the indicators allow",
        "relaxed or dropped\n% of states",
        "tightness\n% of the action bounds left open",
    )
    for axes, title in zip(panels, titles, strict=True):
        axes.set_title(title)
        axes.set_yticks(range(len(names)), names)
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="x", zorder=0)
        axes.set_axisbelow(True)
    height = 0.7 / len(report.sources)
    for i, findings in enumerate(report.sources.values()):
        for each in findings:
            at = names.index(each.name) + (i - (len(report.sources) - 1) / 2) * height
            _draw_findings(panels, each, at, 0.85 * height, colors[each.name], faint=i > 0)
    for axes in panels[1:]:
        axes.set_xlim(0, 104)
    # Room for the counts beside the bars.
    panels[0].set_xlim(0, max(1.0, 1.4 * panels[0].get_xlim()[1]))


def _draw_findings(
    panels: Sequence[Axes],
    found: ConstraintMetrics,
    at: float,
    height: float,
    color: str,
    *,
    faint: bool,
) -> None:
    shares = (found.unsound, found.coverage, found.gave_way)
    for axes, share in zip(panels, shares, strict=False):
        _draw_share(axes, share, at, height, color, faint=faint, told=axes is panels[0])
    _draw_spread(panels[3], found.volume, at, height, color, faint=faint)


def _draw_share(
    axes: Axes,
    share: Share | None,
    at: float,
    height: float,
    color: str,
    *,
    faint: bool,
    told: bool,
) -> None:
    if share is None or share.share is None:
        said = "not judged" if share is None else "no state"
        axes.annotate(said, (0, at), (3, 0), textcoords="offset points", va="center", color=MUTED)
        return
    percent = 100 * share.share
    axes.barh(at, percent, height, color=color, alpha=0.4 if faint else 0.9, zorder=2)
    if told:
        said = f"{share.count:,} of {share.of:,}"
        axes.annotate(
            said, (percent, at), (3, 0), textcoords="offset points", va="center", fontsize=7.5
        )
        return
    error = [[max(percent - 100 * share.low, 0)], [max(100 * share.high - percent, 0)]]
    axes.errorbar(percent, at, xerr=error, color=INK, linewidth=1, capsize=2, zorder=3)


def _draw_spread(
    axes: Axes, found: Quantiles, at: float, height: float, color: str, *, faint: bool
) -> None:
    """Draw a line over all states, a box over the middle 90 % and a mark at the median."""
    if found["median"] is None:
        return
    low, high, least, most, middle = (
        100 * (found[name] or 0.0) for name in ("q05", "q95", "min", "max", "median")
    )
    axes.plot([least, most], [at, at], color=color, linewidth=1, zorder=2)
    axes.barh(at, high - low, height, left=low, color=color, alpha=0.4 if faint else 0.9, zorder=2)
    axes.plot(middle, at, "D", color="white", mec=INK, mew=0.8, markersize=4, zorder=3)


def _draw_scene(
    axes: Axes, scene: WorstState, order: Sequence[str], colors: Mapping[str, str]
) -> None:
    x, y = scene.actions.T.numpy()
    for depth, (mask, mark) in enumerate(zip(_kinds(scene), _MARKS.values(), strict=True)):
        axes.plot(x[mask], y[mask], linestyle="none", zorder=2 if depth < 3 else 7, **mark)
    low, high = scene.region.bounds.low.tolist(), scene.region.bounds.high.tolist()
    pad = [0.06 * (b - a) for a, b in zip(low, high, strict=True)]
    view = (low[0] - pad[0], high[0] + pad[0], low[1] - pad[1], high[1] + pad[1])
    active = scene.region.is_active.tolist()
    for k, name in enumerate(order, start=1):
        for line in set_outline(scene.region.sets[k], view):
            width = 2.4 if name == scene.name else 1.3
            dashes = "-" if active[k] else (0, (1.2, 1.8))
            axes.plot(*line.T, color=colors[name], linewidth=width, linestyle=dashes, zorder=5)
    edge = region_outline(scene.region, range(len(scene.region.sets)))
    axes.plot(*edge.T, color=INK, linewidth=1.0, zorder=6)
    axes.set_xlim(view[0], view[1])
    axes.set_ylim(view[2], view[3])
    axes.set_aspect("equal")
    axes.set_xlabel("$a_1$")
    axes.set_ylabel("$a_2$")
    axes.set_title(
        f"worst for {scene.name}, {scene.source}: {scene.reason}\n{_told(scene.state)}",
        fontsize=8.5,
    )


def _kinds(scene: WorstState) -> list[NDArray[np.bool_]]:
    """Return masks of the actions of each kind, in the order of `_MARKS`."""
    inside, bad, dead = (x.numpy() for x in (scene.inside, scene.violates, scene.dead_end))
    return [bad & ~inside, ~bad & ~inside, ~bad & inside & ~dead, dead, bad & inside]


def _told(state: Mapping[str, object]) -> str:
    """Return a state in few words, or nothing where it has many entries."""
    parts = []
    for name, value in state.items():
        numbers = value if isinstance(value, list) else [value]
        if len(numbers) > 6 or not all(isinstance(x, int | float) for x in numbers):
            return ""
        parts.append(f"{name} ({', '.join(f'{x:.3g}' for x in numbers)})")
    return "; ".join(parts)


def _source_entries(sources: list[str]) -> list[Patch]:
    return [
        Patch(color=MUTED, alpha=0.4 if i else 0.9, label=f"states: {source}")
        for i, source in enumerate(sources)
    ]


def _write_remarks(axes: Axes, report: AuditReport) -> None:
    """Write the meaning of the marks, and the first flaws."""
    axes.set_axis_off()
    entries = [
        Line2D([], [], linestyle="none", **{**mark, "markersize": 8, "label": meaning})
        for meaning, mark in _MARKS.items()
    ]
    entries.append(Line2D([], [], color=INK, linewidth=1, label="what all sets together leave"))
    axes.legend(handles=entries, loc="upper left", title="actions tried in that state")
    lines = [fill(flaw, 48) for flaw in report.flaws[:_MOST_FLAWS]]
    if len(report.flaws) > _MOST_FLAWS:
        lines.append(f"and {len(report.flaws) - _MOST_FLAWS} more")
    text = "\n".join(lines)
    axes.text(0.02, 0.0, text, transform=axes.transAxes, va="bottom", fontsize=8, color=_FLAW)
