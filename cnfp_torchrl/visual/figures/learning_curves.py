"""Learning curves of one run, from the scalars that TorchRL's CSV logger wrote."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator
from numpy.typing import NDArray

from cnfp_torchrl.visual.colors import GOAL, INK, MUTED, constraint_colors
from cnfp_torchrl.visual.figures.canvas import house_style, message_figure, new_figure, say

Curve: TypeAlias = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Steps and values."""

RETURN, EVALUATED, VIOLATIONS = "train/return", "evaluation/return", "violations/"
TIMES = ("train/steps_per_second", "train/seconds", "train/processor_seconds")
"""Of the machine, not of learning: not drawn."""

RELAXATIONS = {
    "relaxed/": "share of steps relaxed",
    "dropped/": "share of steps dropped",
    "relaxation/": "largest relaxation ({unit})",
    "mean_relaxation/": "mean relaxation ({unit})",
}
"""What is logged of constraints that gave way: one panel each, where it ever was more than 0."""

JUDGED = "evaluation/violations/"
"""Of each constraint, the violating steps in an evaluation during training."""

_LOSSES = {"qvalue": "critic", "alpha": "α"}
_TITLES = {"alpha": "entropy coefficient α", "entropy": "policy entropy (nats)"}
_COLUMNS = 4


def read_scalars(metrics: Path) -> dict[str, Curve]:
    """Return the logged scalars by name, such as ``train/return``; none if there is no such folder.

    Args:
        metrics: The folder of the CSV logger's experiment, which holds ``scalars/``.

    Raises:
        ValueError: when a file is not rows of step and value, naming it.
    """
    root = metrics / "scalars"
    curves = {}
    for path in sorted(root.rglob("*.csv")):
        lines = [line for line in path.read_text().splitlines() if line.strip()]
        try:
            rows = np.array([[float(x) for x in line.split(",")] for line in lines])
            steps, values = rows.reshape(-1, 2).T
        except ValueError:
            raise ValueError(f"{path}: expected rows 'step,value', given {lines[:3]}") from None
        if len(steps):
            curves[path.relative_to(root).with_suffix("").as_posix()] = (steps, values)
    return curves


def learning_curves(
    curves: Mapping[str, Curve],
    *,
    colors: Mapping[str, str] | None = None,
    title: str = "Learning curves",
    unit: str = "action units",
) -> Figure:
    """Draw return, violations by constraint, and whatever else was logged of learning.

    Relaxations are drawn where a constraint was relaxed. A panel without a curve says why; so does
    the figure of a run without any scalars.

    Args:
        curves: Steps and values by name, see `read_scalars`.
        colors: The colors of the constraints; None chooses them by the names found.
        title: The title above the panels.
        unit: The unit of distances between actions.
    """
    if not curves:
        return message_figure(
            title,
            "This run logged no scalars that can be drawn.\n"
            "Train with logger=csv or logger=csv_tensorboard to see its curves here.",
        )
    counted = _by_constraint(curves, VIOLATIONS)
    headings = {JUDGED: "violations in an evaluation (steps)"}
    headings |= {prefix: heading.format(unit=unit) for prefix, heading in RELAXATIONS.items()}
    groups = {
        heading: group
        for prefix, heading in headings.items()
        if (group := _by_constraint(curves, prefix))
        # That no constraint was broken is news, that none gave way is not.
        and (prefix == JUDGED or any(values.any() for _, values in group.values()))
    }
    others = {
        name: curve
        for name, curve in curves.items()
        if name not in (RETURN, EVALUATED, *TIMES) and not name.startswith((VIOLATIONS, *headings))
    }
    panels = 2 + len(groups) + len(others)
    rows = -(-panels // _COLUMNS)
    columns = -(-panels // rows)
    last = max(float(steps.max()) for steps, _ in curves.values())
    with house_style():
        figure = new_figure(3.3 * columns, 2.5 * rows + 0.4)
        figure.suptitle(title)
        axes = [figure.add_subplot(rows, columns, 1 + i) for i in range(panels)]
        _draw_return(axes[0], curves.get(RETURN), curves.get(EVALUATED))
        named = {name for group in (counted, *groups.values()) for name in group}
        colors = dict(colors or constraint_colors(sorted(named)))
        _draw_violations(axes[1], counted, colors)
        for panel, (heading, group) in zip(axes[2:], groups.items(), strict=False):
            panel.set_title(heading)
            if heading == headings[JUDGED]:
                _draw_counts(panel, group, colors)
            else:
                _draw_by_constraint(panel, group, colors, "{:.3g}")
        for panel, (name, curve) in zip(axes[2 + len(groups) :], others.items(), strict=True):
            panel.set_title(_title(name))
            _plot(panel, curve)
        for panel in axes:
            panel.grid(visible=True)
            panel.spines[["top", "right"]].set_visible(False)
            panel.set_xlim(0, last)
            panel.xaxis.set_major_formatter(EngFormatter(sep=""))
            panel.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
            panel.set_xlabel("environment steps")
    return figure


def _title(name: str) -> str:
    group, _, last = name.rpartition("/")
    if group == "loss":
        return f"{_LOSSES.get(last, last)} loss"
    title = _TITLES.get(last, last.replace("_", " "))
    return f"{title} in an evaluation" if group == "evaluation" else title


def _draw_return(axes: Axes, curve: Curve | None, evaluated: Curve | None) -> None:
    axes.set_title("mean return of an episode")
    if curve is not None:
        _plot(axes, curve)
        axes.lines[-1].set_label("training")
    if evaluated is not None:
        axes.plot(*evaluated, color=GOAL, linewidth=1.4, marker="o", ms=3.5, label="evaluation")
        axes.legend(loc="best")
    elif curve is None:
        say(axes, "no episode ended\nbetween two entries of the log")


def _draw_violations(axes: Axes, counted: Mapping[str, Curve], colors: Mapping[str, str]) -> None:
    axes.set_title("violations in training (steps)")
    if not counted:
        say(axes, "none counted")
        return
    _draw_counts(axes, counted, colors)


def _draw_counts(axes: Axes, counted: Mapping[str, Curve], colors: Mapping[str, str]) -> None:
    _draw_by_constraint(axes, counted, colors, "{:,.0f}")
    highest = max(float(values.max()) for _, values in counted.values())
    axes.set_ylim(-0.04 * max(highest, 1), 1.05 * max(highest, 1))
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))


def _draw_by_constraint(
    axes: Axes, curves: Mapping[str, Curve], colors: Mapping[str, str], form: str
) -> None:
    # Curves that coincide, as at exactly 0, all stay visible: the first is wide, the last is thin.
    widths = 1.4 + 1.4 * np.arange(len(curves))[::-1]
    for (name, (steps, values)), width in zip(curves.items(), widths, strict=True):
        label = f"{name}: {form.format(values[-1])}"
        axes.plot(steps, values, color=colors[name], linewidth=width, label=label)
    axes.legend(loc="upper left")


def _by_constraint(curves: Mapping[str, Curve], prefix: str) -> dict[str, Curve]:
    return {n.removeprefix(prefix): curve for n, curve in curves.items() if n.startswith(prefix)}


def _plot(axes: Axes, curve: Curve) -> None:
    steps, values = curve
    # A line through one point is invisible.
    marker = "o" if len(steps) == 1 else None
    axes.plot(steps, values, color=INK, linewidth=1.4, marker=marker, markersize=4)
    if len(steps) == 1:
        note = (0.98, 0.03)
        axes.text(*note, "one entry", transform=axes.transAxes, ha="right", color=MUTED)
