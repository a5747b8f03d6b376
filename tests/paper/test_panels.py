"""Panels that compare methods."""

import numpy as np
import pytest
from matplotlib.text import Text

from cnfp_torchrl.visual.figures.canvas import new_figure
from experiments.paper.labels import Label
from experiments.paper.panels import (
    count_axis,
    draw_band,
    draw_estimates,
    legend_below,
    spread_labels,
    step_axis,
)
from experiments.paper.statistics import Band, Interval
from tests.pictures import draws

LABELS = [
    Label("first", "#4B2E83", "D"),
    Label("second", "#009E73", "o"),
    Label("third", "#888888", "X"),
]


def test_curves_that_coincide_can_be_told() -> None:
    figure = new_figure(4, 3)
    axes = figure.add_subplot()
    x, zero = np.arange(30.0), np.zeros(30)
    for rank, label in enumerate(LABELS):
        draw_band(axes, label, Band(x, zero, zero, zero), rank=rank, of=len(LABELS))
    step_axis(axes)
    count_axis(axes.yaxis, 0)
    legend_below(figure, LABELS)
    marked = [line.get_markevery() for line in axes.lines if line.get_marker() in "DoX"]
    assert len(marked) == len({start for start, _ in marked}) == len(LABELS)
    assert draws(figure)


@pytest.mark.parametrize("highest", [0, 1, 999, 1000, 123_456])
@pytest.mark.parametrize("smallest", [0.1, 1.0])
@pytest.mark.parametrize("name", ["x", "y"])
def test_count_axis_holds_zero_and_the_highest(name: str, highest: float, smallest: float) -> None:
    axes = new_figure(4, 3).add_subplot()
    axis = axes.xaxis if name == "x" else axes.yaxis
    count_axis(axis, highest, smallest=smallest)
    low, high = axes.get_xlim() if name == "x" else axes.get_ylim()
    assert low < 0 < smallest < high
    assert high >= highest
    ticks = axis.get_majorticklocs()
    assert 0 in ticks
    assert smallest in ticks


def test_estimates_and_what_is_said_without_one() -> None:
    figure = new_figure(4, 3)
    axes = figure.add_subplot()
    estimates = [Interval(1.0, 0.8, 1.3, 2), Interval(2.0, 2.0, 2.0, 1), None]
    draw_estimates(axes, LABELS, estimates, [[0.9, 1.1], [2.0], []], absent=["", "", "never"])
    assert [label.get_text() for label in axes.get_yticklabels()] == ["first", "second", "third"]
    assert [text.get_text() for text in axes.texts] == ["never"]
    ends = [line.get_xdata() for line in axes.lines if len(line.get_xdata()) == 2]
    assert (0.8, 1.3) in [tuple(end) for end in ends]
    assert draws(figure)


def test_names_do_not_cover_each_other() -> None:
    figure = new_figure(5, 4)
    axes = figure.add_subplot()
    axes.set(xlim=(0, 1), ylim=(0, 1))
    spread_labels(axes, [(0.1, 0.5, label) for label in LABELS])
    assert draws(figure)
    figure.draw_without_rendering()
    # Of the words alone: the extent of an annotation holds its line, too.
    boxes = [Text.get_window_extent(text) for text in axes.texts]
    assert len(boxes) == 3
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])
