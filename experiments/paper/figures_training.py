"""Training, method by method: return, cumulative violations, violations per episode."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cnfp_torchrl.visual.comparison import Look, count_axis, draw_band, legend_below, step_axis
from cnfp_torchrl.visual.figures.canvas import house_style, new_figure
from experiments.paper.labels import in_order, label
from experiments.paper.records import RETURN, VIOLATIONS, Record, Series
from experiments.paper.statistics import band, by_method, round_ends


def draw_training(records: Sequence[Record]) -> Figure:
    """Draw return and each constraint's violations since the start over training."""
    constraints = records[0].constraints
    with house_style():
        figure = new_figure(4.2 * (1 + len(constraints)), 4.4)
        axes = figure.add_subplot(1, 1 + len(constraints), 1)
        axes.set_title("return of an episode, in training")
        _draw_curves(axes, records, lambda run: run.curves[RETURN])
        for i, name in enumerate(constraints):
            axes = figure.add_subplot(1, 1 + len(constraints), 2 + i)
            axes.set_title(f"{name}: violating steps since the start")
            highest = _draw_curves(axes, records, _curve(VIOLATIONS + name))
            count_axis(axes.yaxis, highest)
        legend_below(figure, looks(records))
    return figure


def draw_violation_rates(records: Sequence[Record]) -> Figure:
    """Draw each constraint's violations per episode over training."""
    constraints = records[0].constraints
    with house_style():
        figure = new_figure(4.9 * len(constraints), 4.2)
        for i, name in enumerate(constraints):
            axes = figure.add_subplot(1, len(constraints), 1 + i)
            axes.set_title(f"{name}: violating steps per episode")
            highest = _draw_curves(axes, records, _rate(name))
            count_axis(axes.yaxis, highest, smallest=0.1)
        legend_below(figure, looks(records))
    return figure


def looks(records: Sequence[Record]) -> list[Look]:
    """Return the looks of all methods, in order."""
    return [label(method).look for method in in_order(by_method(records))]


def violation_rate(record: Record, constraint: str) -> Series:
    """Return a constraint's violations per episode in each round of episodes, see `round_ends`."""
    curve = record.curves[VIOLATIONS + constraint]
    outcome = next(iter(record.evaluation.values()))
    length = outcome.steps / outcome.episodes
    edges = np.array([0.0, *round_ends(record)])
    counts = np.diff(np.interp(edges, [0, *curve.steps], [0.0, *curve.values]))
    rates = counts * length / np.diff(edges)
    middles = (edges[:-1] + edges[1:]) / 2
    return Series(tuple(round(each) for each in middles), tuple(rates.tolist()))


def _curve(name: str) -> Callable[[Record], Series]:
    return lambda run: run.curves[name]


def _rate(constraint: str) -> Callable[[Record], Series]:
    return lambda run: violation_rate(run, constraint)


def _draw_curves(axes: Axes, records: Sequence[Record], curve: Callable[[Record], Series]) -> float:
    """Draw a curve of every method; return the highest value of all bands."""
    runs = by_method(records)
    highest = 0.0
    for place, method in enumerate(in_order(runs)):
        drawn = band([curve(run) for run in runs[method]])
        highest = max(highest, float(drawn.high.max()))
        look, edges = label(method).look, (drawn.low, drawn.high)
        draw_band(axes, look, drawn.steps, drawn.value, *edges, place=place, of=len(runs))
    step_axis(axes)
    return highest
