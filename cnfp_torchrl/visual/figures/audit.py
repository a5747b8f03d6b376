"""The figure of an audit: numbers by constraint, and the states that speak most against one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any, TypedDict

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
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


class _Bar(TypedDict):
    height: float
    color: str
    faint: bool


_MOST_SCENES = 4
_MOST_FLAWS = 6


def audit_figure(report: AuditReport) -> Figure:
    """Draw an audit.

    The upper row holds the numbers by constraint; bars come from each source of states, and kinds
    of flaws that were not found have no panel. The lower row lists the flaws and shows, for actions
    in the plane and for each constraint, the state that speaks most against its set: every action
    tried there.

    Args:
        report: The report of `cnfp_torchrl.audit.audit`.
    """
    colors = constraint_colors(report.order) | {TOGETHER: INK}
    scenes = [scene for scene in report.worst_states if scene.actions.shape[-1] == 2][:_MOST_SCENES]
    with house_style():
        has_lower = bool(scenes or report.flaws)
        figure = new_figure(13.0, 7.4 if has_lower else 3.4)
        verdict = f"{len(report.flaws)} flaws" if report.flaws else "no flaw found"
        figure.suptitle(f"Audit of {report.subject['environment']}: {verdict}")
        upper, *lower = figure.subfigures(1 + has_lower, 1, squeeze=False)[:, 0]
        _draw_numbers(upper, report, colors)
        upper.legend(
            handles=_source_entries(list(report.sources)), loc="outside lower center", ncols=2
        )
        for part in lower:
            *panels, remarks = part.subplots(1, len(scenes) + 1, squeeze=False)[0]
            names = report.subject["names"]["action"]
            for axes, scene in zip(panels, scenes, strict=True):
                _draw_scene(axes, scene, report.order, colors)
                axes.set_xlabel(names[0])
                axes.set_ylabel(names[1])
            _write_remarks(remarks, report, has_scenes=bool(scenes))
    return figure


def save_audit(report: AuditReport, path: Path) -> Path:
    """Draw an audit into a PNG file and return where it is."""
    return save_png(audit_figure(report), path)


_Shares = dict[str, Callable[[ConstraintMetrics], Share | None]]

_FLAWS: _Shares = {
    "unsound\n% of actions in the set": lambda x: x.unsound,
    "escaped\n% of the flow's samples": lambda x: x.escaped,
    "dead ends\n% of allowed actions": lambda x: x.dead_ends,
}
_FINDINGS: _Shares = {
    "coverage\n% of what the indicators allow": lambda x: x.coverage,
    "relaxed or dropped\n% of states": lambda x: x.gave_way,
}
_TIGHTNESS = "tightness\n% of the action bounds left open"
_LED_INTO = "led into a violation\nsteps of the policy"


def _draw_numbers(part: SubFigure, report: AuditReport, colors: Mapping[str, str]) -> None:
    found = [metrics for findings in report.sources.values() for metrics in findings]
    flaws = {
        title: share_of
        for i, (title, share_of) in enumerate(_FLAWS.items())
        if i == 0
        or any((share := share_of(metrics)) is not None and share.count for metrics in found)
    }
    led_into = {name: count for name, count in report.executed.led_into.items() if count}
    titles = [*flaws, *([_LED_INTO] if led_into else []), *_FINDINGS, _TIGHTNESS]
    panels = dict(zip(titles, part.subplots(1, len(titles), squeeze=False)[0], strict=True))
    names = [*report.order, TOGETHER]
    for title, axes in panels.items():
        axes.set_title(title)
        axes.set_yticks(range(len(names)), names)
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="x", zorder=0)
        axes.set_axisbelow(True)
    height = 0.7 / len(report.sources)
    for i, findings in enumerate(report.sources.values()):
        for metrics in findings:
            at = names.index(metrics.name) + (i - (len(report.sources) - 1) / 2) * height
            style: _Bar = {"height": 0.85 * height, "color": colors[metrics.name], "faint": i > 0}
            for title, share_of in (flaws | _FINDINGS).items():
                _draw_share(panels[title], share_of(metrics), at, counted=title in flaws, **style)
            _draw_spread(panels[_TIGHTNESS], metrics.volume, at, **style)
    for name, count in led_into.items():
        at = names.index(name) if name in names else len(names) - 1
        panels[_LED_INTO].barh(at, count, 0.6, color=colors.get(name, INK), alpha=0.9, zorder=2)
        _write_count(panels[_LED_INTO], f"{count:,} of {report.executed.steps:,}", count, at)
    for title, axes in panels.items():
        # Room for the counts beside the bars.
        is_count = title in flaws or title == _LED_INTO
        axes.set_xlim(0, max(1.0, 1.6 * axes.get_xlim()[1]) if is_count else 104)


def _draw_share(
    axes: Axes,
    share: Share | None,
    at: float,
    height: float,
    color: str,
    *,
    faint: bool,
    counted: bool,
) -> None:
    if share is None or share.share is None:
        _write_count(axes, "not judged" if share is None else "no state", 0, at, color=MUTED)
        return
    percent = 100 * share.share
    axes.barh(at, percent, height, color=color, alpha=0.4 if faint else 0.9, zorder=2)
    if counted:
        _write_count(axes, f"{share.count:,} of {share.of:,}", percent, at, fontsize=7.5)
        return
    error = [[max(percent - 100 * share.low, 0)], [max(100 * share.high - percent, 0)]]
    axes.errorbar(percent, at, xerr=error, color=INK, linewidth=1, capsize=2, zorder=3)


def _write_count(axes: Axes, text: str, x: float, y: float, **style: Any) -> None:
    axes.annotate(text, (x, y), (3, 0), textcoords="offset points", va="center", **style)


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
    axes.set_title(
        f"worst for {scene.name}, {scene.source}: {scene.reason}\n{_state_text(scene.state)}",
        fontsize=8.5,
    )


def _kinds(scene: WorstState) -> list[NDArray[np.bool_]]:
    """Return masks of the actions of each kind, in the order of `_MARKS`."""
    inside, bad, dead = (x.numpy() for x in (scene.inside, scene.violates, scene.dead_end))
    return [bad & ~inside, ~bad & ~inside, ~bad & inside & ~dead, dead, bad & inside]


def _state_text(state: Mapping[str, object]) -> str:
    """Return a state as a short text, empty where it has many entries."""
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


def _write_remarks(axes: Axes, report: AuditReport, *, has_scenes: bool) -> None:
    """Write the meaning of the marks, and the first flaws."""
    axes.set_axis_off()
    if has_scenes:
        entries = [
            Line2D([], [], linestyle="none", **{**mark, "markersize": 8, "label": meaning})
            for meaning, mark in _MARKS.items()
        ]
        entries.append(Line2D([], [], color=INK, linewidth=1, label="what all sets together leave"))
        axes.legend(handles=entries, loc="upper left", title="actions tried in that state")
    width = 48 if has_scenes else 150
    lines = [fill(flaw, width) for flaw in report.flaws[:_MOST_FLAWS]]
    if len(report.flaws) > _MOST_FLAWS:
        lines.append(f"and {len(report.flaws) - _MOST_FLAWS} more")
    text = "\n".join(lines)
    at, align = (0.0, "bottom") if has_scenes else (1.0, "top")
    axes.text(0.02, at, text, transform=axes.transAxes, va=align, fontsize=8, color=_FLAW)
