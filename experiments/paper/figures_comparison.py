"""Methods beside each other at the end: scores, speed, violations, and a constraint added later."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from cnfp_torchrl.visual.comparison import (
    Estimate,
    count_axis,
    draw_estimates,
    draw_rows_apart,
    spread_labels,
)
from cnfp_torchrl.visual.figures.canvas import house_style, message_figure, new_figure
from experiments.paper.labels import in_order, label
from experiments.paper.records import Outcome, Record
from experiments.paper.statistics import (
    TARGET_SCORE,
    Interval,
    Reached,
    area_under_score,
    by_method,
    interquartile_mean,
    reached,
    total_violations,
)

STOCHASTIC, DETERMINISTIC = "stochastic", "deterministic"


def draw_trade_off(records: Sequence[Record]) -> Figure:
    """Draw the score after training against all violations of the run, each run and each method."""
    runs = by_method(records)
    methods = in_order(runs)
    with house_style():
        figure = new_figure(8.6, 4.4)
        axes = figure.add_subplot()
        points = []
        # The first method is drawn last, above the others.
        for method in reversed(methods):
            look = label(method).look
            counts = [float(total_violations(run)) for run in runs[method]]
            scores = [run.evaluation[STOCHASTIC].score for run in runs[method]]
            axes.plot(counts, scores, ".", color=look.color, alpha=0.5, markersize=6, mew=0)
            count, score = interquartile_mean(counts), interquartile_mean(scores)
            for ends in (
                ((count.low, score.value), (count.high, score.value)),
                ((count.value, score.low), (count.value, score.high)),
            ):
                axes.plot(*np.array(ends, dtype=float).T, color=look.color, linewidth=1.4)
            axes.plot(
                count.value, score.value, look.marker, color=look.color, markersize=10,
                markeredgecolor="white", zorder=5,
            )  # fmt: skip
            points.append((count.value, score.value, look))
        count_axis(axes.xaxis, max(total_violations(run) for run in records))
        axes.set_xlabel(
            "violating steps of a whole run: training and evaluation (0 is on the axis)"
        )
        axes.set_ylabel("score after training")
        axes.grid(visible=True)
        axes.spines[["top", "right"]].set_visible(False)
        spread_labels(axes, points)
    return figure


def draw_summary(records: Sequence[Record]) -> Figure:
    """Draw interquartile means with their intervals: score, area, speed, violations."""
    moment = f"to a score of {TARGET_SCORE:g}"
    with house_style():
        figure = new_figure(12.6, 5.9)
        panels = [figure.add_subplot(2, 3, 1 + i) for i in range(6)]
        titles = (
            "score, stochastic policy",
            "score, deterministic policy",
            "area under the training score",
            f"steps {moment}",
            f"processor seconds {moment}",
            "violating steps of a whole run",
        )
        for axes, title in zip(panels, titles, strict=True):
            axes.set_title(title)
        _draw_values(panels[0], records, lambda run: run.evaluation[STOCHASTIC].score)
        _draw_values(panels[1], records, lambda run: run.evaluation[DETERMINISTIC].score)
        _draw_values(panels[2], records, area_under_score)
        _draw_moments(panels[3], records, lambda moment: float(moment.steps))
        _draw_moments(panels[4], records, lambda moment: moment.processor_seconds)
        _draw_values(panels[5], records, lambda run: float(total_violations(run)))
        count_axis(panels[5].xaxis, max(total_violations(run) for run in records))
        for i, axes in enumerate(panels):
            if i % 3:
                axes.set_yticklabels([])
    return figure


def draw_afterwards(records: Sequence[Record]) -> Figure:
    """Draw what a constraint that is switched on after training does to return and violations."""
    changes = list(dict.fromkeys(name for run in records for name in run.afterwards))
    if not changes:
        return message_figure("", "No run was evaluated after a change of its constraints.")
    changed = [run for run in records if all(name in run.afterwards for name in changes)]
    with house_style():
        figure = new_figure(12.6, 5.9)
        columns = 1 + len(changes)
        top = [figure.add_subplot(2, columns, 1 + i) for i in range(columns)]
        bottom = [figure.add_subplot(2, columns, 1 + columns + i) for i in range(columns)]
        for i, change in enumerate([None, *changes]):
            top[i].set_title(f"return, {change or 'as trained'}")
            bottom[i].set_title(f"violating steps, {change or 'as trained'}")
            _draw_values(top[i], changed, _outcome(change, lambda each: each.return_mean))
            counted = _outcome(change, lambda each: float(sum(each.violations.values())))
            _draw_values(bottom[i], changed, counted)
        ends = [end for axes in top for end in axes.get_xlim()]
        highest = max(axes.get_xlim()[1] for axes in bottom)
        for axes in top:
            axes.set_xlim(min(ends), max(ends))
        for axes in bottom:
            count_axis(axes.xaxis, highest)
        for axes in (*top[1:], *bottom[1:]):
            axes.set_yticklabels([])
    return figure


def _outcome(change: str | None, value: Callable[[Outcome], float]) -> Callable[[Record], float]:
    """Return what takes a value from a run's evaluation, after a change or before any."""
    return lambda run: value(
        (run.evaluation if change is None else run.afterwards[change])[STOCHASTIC]
    )


def _draw_values(axes: Axes, records: Sequence[Record], value: Callable[[Record], float]) -> None:
    runs = by_method(records)
    methods = in_order(runs)
    values = [[value(run) for run in runs[method]] for method in methods]
    estimates = [_estimate(interquartile_mean(each)) for each in values]
    draw_rows_apart(axes, len(methods))
    draw_estimates(axes, [label(method).look for method in methods], estimates, values)
    axes.xaxis.set_major_locator(MaxNLocator(5))


def _draw_moments(axes: Axes, records: Sequence[Record], value: Callable[[Reached], float]) -> None:
    """Draw when runs reached the score; a method of which some never did has no estimate."""
    runs = by_method(records)
    methods = in_order(runs)
    moments = [[moment for run in runs[m] if (moment := reached(run))] for m in methods]
    values = [[value(moment) for moment in each] for each in moments]
    whole = [len(each) == len(runs[m]) for each, m in zip(values, methods, strict=True)]
    estimates = [
        _estimate(interquartile_mean(each)) if all_of_them else None
        for each, all_of_them in zip(values, whole, strict=True)
    ]
    said = [
        f"{len(each) or 'none'} of {len(runs[m])} runs reached it"
        for each, m in zip(values, methods, strict=True)
    ]
    draw_rows_apart(axes, len(methods))
    draw_estimates(axes, [label(method).look for method in methods], estimates, values, absent=said)
    axes.set_xlim(left=0)
    if not any(values):
        axes.set_xticks([])
        return
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))


def _estimate(interval: Interval) -> Estimate:
    return Estimate(interval.value, interval.low, interval.high)
