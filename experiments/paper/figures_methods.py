"""Methods beside each other: over training, at its end, after a change, and hostile networks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from cnfp_torchrl.visual.figures.canvas import house_style, message_figure, new_figure
from experiments.paper.labels import Label, in_order, label
from experiments.paper.panels import (
    count_axis,
    draw_band,
    draw_estimates,
    legend_below,
    spread_labels,
    step_axis,
)
from experiments.paper.records import RETURN, VIOLATIONS, HostileRun, Outcome, Record, Series
from experiments.paper.statistics import (
    TARGET_SCORE,
    Reached,
    area_under_score,
    band,
    interquartile_mean,
    reached,
    violation_rate,
)

Runs = Mapping[str, Sequence[Record]]
"""The records of each method, in the order in which they are shown."""


def draw_trade_off(runs: Runs) -> Figure:
    """Draw the score after training against all violations of the run, each run and each method."""
    with house_style():
        figure = new_figure(8.6, 4.4)
        axes = figure.add_subplot()
        points = []
        # The first method is drawn last, above the others.
        for method, records in reversed(list(runs.items())):
            look = label(method)
            counts = [float(run.violations) for run in records]
            scores = [run.evaluation.stochastic.score for run in records]
            axes.plot(counts, scores, ".", color=look.color, alpha=0.5, markersize=6, mew=0)
            count, score = interquartile_mean(counts), interquartile_mean(scores)
            across, along = (count.low, count.high), (score.low, score.high)
            axes.plot(across, (score.value, score.value), color=look.color, linewidth=1.4)
            axes.plot((count.value, count.value), along, color=look.color, linewidth=1.4)
            axes.plot(
                count.value, score.value, look.marker, color=look.color, markersize=10,
                markeredgecolor="white", zorder=5,
            )  # fmt: skip
            points.append((count.value, score.value, look))
        count_axis(axes.xaxis, _most_violations(runs))
        axes.set_xlabel(
            "violating steps of a whole run: training and evaluation (0 is on the axis)"
        )
        axes.set_ylabel("score after training")
        axes.grid(visible=True)
        axes.spines[["top", "right"]].set_visible(False)
        spread_labels(axes, points)
    return figure


def draw_training(runs: Runs) -> Figure:
    """Draw return and each constraint's violations since the start over training."""
    constraints = _constraints(runs)
    with house_style():
        figure = new_figure(4.2 * (1 + len(constraints)), 4.4)
        first, *panels = _panels(figure, 1, 1 + len(constraints))
        first.set_title("return of an episode, in training")
        _draw_curves(first, runs, _curve(RETURN))
        for axes, name in zip(panels, constraints, strict=True):
            axes.set_title(f"{name}: violating steps since the start")
            highest = _draw_curves(axes, runs, _curve(VIOLATIONS + name))
            count_axis(axes.yaxis, highest)
        legend_below(figure, _looks(runs))
    return figure


def draw_violation_rates(runs: Runs) -> Figure:
    """Draw each constraint's violations per episode over training."""
    constraints = _constraints(runs)
    with house_style():
        figure = new_figure(4.9 * len(constraints), 4.2)
        panels = _panels(figure, 1, len(constraints))
        for axes, name in zip(panels, constraints, strict=True):
            axes.set_title(f"{name}: violating steps per episode")
            highest = _draw_curves(axes, runs, partial(violation_rate, constraint=name))
            count_axis(axes.yaxis, highest, smallest=0.1)
        legend_below(figure, _looks(runs))
    return figure


def draw_summary(runs: Runs) -> Figure:
    """Draw interquartile means with their intervals: score, area, speed, violations."""
    moment = f"to a score of {TARGET_SCORE:g}"
    with house_style():
        figure = new_figure(12.6, 5.9)
        panels = _panels(figure, 2, 3)
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
        _draw_values(panels[0], runs, lambda run: run.evaluation.stochastic.score)
        _draw_values(panels[1], runs, lambda run: run.evaluation.deterministic.score)
        _draw_values(panels[2], runs, area_under_score)
        _draw_moments(panels[3], runs, lambda moment: moment.steps)
        _draw_moments(panels[4], runs, lambda moment: moment.processor_seconds)
        _draw_values(panels[5], runs, lambda run: float(run.violations))
        count_axis(panels[5].xaxis, _most_violations(runs))
        _name_rows_once(panels, 3)
    return figure


def draw_afterwards(runs: Runs) -> Figure:
    """Draw what a constraint that is switched on after training does to return and violations."""
    changes = changes_of(runs)
    if not changes:
        return message_figure("", "No run was evaluated after a change of its constraints.")
    changed = {
        method: [run for run in records if {*changes} <= {*run.afterwards}]
        for method, records in runs.items()
    }
    changed = {method: records for method, records in changed.items() if records}
    columns = 1 + len(changes)
    with house_style():
        figure = new_figure(12.6, 5.9)
        panels = _panels(figure, 2, columns)
        top, bottom = panels[:columns], panels[columns:]
        for above, below, change in zip(top, bottom, (None, *changes), strict=True):
            above.set_title(f"return, {change or 'as trained'}")
            below.set_title(f"violating steps, {change or 'as trained'}")
            _draw_values(
                above, changed, _outcome(change, lambda evaluation: evaluation.return_mean)
            )
            counted = _outcome(
                change, lambda evaluation: float(sum(evaluation.violations.values()))
            )
            _draw_values(below, changed, counted)
        ends = [end for axes in top for end in axes.get_xlim()]
        highest = max(axes.get_xlim()[1] for axes in bottom)
        for above, below in zip(top, bottom, strict=True):
            above.set_xlim(min(ends), max(ends))
            count_axis(below.xaxis, highest)
        _name_rows_once(panels, columns)
    return figure


def draw_hostile(flows: Mapping[str, Sequence[HostileRun]]) -> Figure:
    """Draw, for each flow and constraint, the violations per million steps of each network."""
    names = in_order(flows)
    runs = [flows[name] for name in names]
    constraints = list(runs[0][0].violations)

    def rate(run: HostileRun, constraint: str) -> float:
        return 1e6 * run.violations[constraint] / run.steps

    with house_style():
        figure = new_figure(5.6 * len(constraints), 0.55 * len(names) + 1.2)
        panels = _panels(figure, 1, len(constraints))
        for axes, constraint in zip(panels, constraints, strict=True):
            axes.set_title(f"{constraint}: violating steps per million, one dot a network")
            said = [
                f"{sum(r.violations[constraint] for r in of_method):,} in "
                f"{sum(r.steps for r in of_method):,} steps"
                for of_method in runs
            ]
            rates = [[rate(run, constraint) for run in of_method] for of_method in runs]
            draw_estimates(axes, _looks(names), [None] * len(names), rates, absent=said)
            highest = max(
                rate(run, name) for of_method in runs for run in of_method for name in constraints
            )
            count_axis(axes.xaxis, highest)
        _name_rows_once(panels, len(constraints))
    return figure


def changes_of(runs: Runs) -> list[str]:
    """Return the names of all changes after which a run was evaluated."""
    names = (name for records in runs.values() for run in records for name in run.afterwards)
    return list(dict.fromkeys(names))


def _outcome(change: str | None, value: Callable[[Outcome], float]) -> Callable[[Record], float]:
    """Return what takes a value from what a stochastic policy did, after a change or before any."""
    return lambda run: value(
        (run.evaluation if change is None else run.afterwards[change]).stochastic
    )


def _curve(name: str) -> Callable[[Record], Series]:
    return lambda run: run.curves[name]


def _constraints(runs: Runs) -> tuple[str, ...]:
    return next(iter(runs.values()))[0].constraints


def _most_violations(runs: Runs) -> int:
    return max(run.violations for records in runs.values() for run in records)


def _looks(methods: Iterable[str]) -> list[Label]:
    return [label(method) for method in methods]


def _panels(figure: Figure, rows: int, columns: int) -> list[Axes]:
    return [figure.add_subplot(rows, columns, 1 + i) for i in range(rows * columns)]


def _name_rows_once(panels: Sequence[Axes], columns: int) -> None:
    """Take the methods' names from all panels but the first of each row."""
    for i, axes in enumerate(panels):
        if i % columns:
            axes.set_yticklabels([])


def _draw_curves(axes: Axes, runs: Runs, curve: Callable[[Record], Series]) -> float:
    """Draw a curve of every method; return the highest value of all bands."""
    highest = 0.0
    for rank, (method, records) in enumerate(runs.items()):
        shown = band([curve(run) for run in records])
        highest = max(highest, float(shown.high.max()))
        draw_band(axes, label(method), shown, rank=rank, of=len(runs))
    step_axis(axes)
    return highest


def _draw_values(axes: Axes, runs: Runs, value: Callable[[Record], float]) -> None:
    values = [[value(run) for run in records] for records in runs.values()]
    draw_estimates(
        axes, _looks(runs), [interquartile_mean(of_method) for of_method in values], values
    )
    axes.xaxis.set_major_locator(MaxNLocator(5))


def _draw_moments(axes: Axes, runs: Runs, value: Callable[[Reached], float]) -> None:
    """Draw when runs reached the score; a method of which some never did has no estimate."""
    moments = [[reached(run) for run in records] for records in runs.values()]
    values = [[value(moment) for moment in of_method if moment] for of_method in moments]
    estimates = [
        interquartile_mean(v) if all(m) else None for v, m in zip(values, moments, strict=True)
    ]
    said = [
        f"{len(v) or 'none'} of {len(m)} runs reached it"
        for v, m in zip(values, moments, strict=True)
    ]
    draw_estimates(axes, _looks(runs), estimates, values, absent=said)
    axes.set_xlim(left=0)
    if not any(values):
        axes.set_xticks([])
        return
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
