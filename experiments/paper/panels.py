"""Methods beside each other: curves with bands, estimates with intervals, counts from 0."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis, YAxis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, FixedLocator, NullLocator, StrMethodFormatter

from cnfp_torchrl.visual.colors import INK, MUTED
from experiments.paper.labels import Label
from experiments.paper.statistics import Band, Interval

_MARKS = 6
_NAME_SIZE = 9.0


def draw_band(axes: Axes, label: Label, band: Band, *, rank: int, of: int) -> None:
    """Draw a method's curve and the band of its intervals.

    Args:
        axes: A panel.
        label: The label of the method.
        band: What is drawn.
        rank: The rank of the method among those of the panel; the first lies above the others,
            and markers stand apart, so that curves that coincide, as at 0, can still be told.
        of: The number of methods in the panel.
    """
    x, every, layer = band.steps, max(of, len(band.steps) // _MARKS), of - rank
    axes.fill_between(
        x, band.low, band.high, color=label.color, alpha=0.18, linewidth=0, zorder=2 + layer
    )
    axes.plot(x, band.value, color=label.color, linewidth=1.5, zorder=2 + layer)
    axes.plot(
        x, band.value, label.marker, color=label.color, markersize=5,
        markevery=(every * rank // of, every), markeredgecolor="white", markeredgewidth=0.6,
        zorder=2 + of + layer,
    )  # fmt: skip


def draw_estimates(
    axes: Axes,
    labels: Sequence[Label],
    estimates: Sequence[Interval | None],
    runs: Sequence[Sequence[float]],
    *,
    absent: Sequence[str] = (),
) -> None:
    """Draw one row for each method: its runs as faint dots, the estimate and its interval.

    Args:
        axes: An empty panel; the first method comes at the top.
        labels: The labels of the methods.
        estimates: One for each, None where there is none.
        runs: The values behind each estimate.
        absent: What to say where there is no estimate, one for each.
    """
    for row in range(1, len(labels), 2):
        axes.axhspan(row - 0.5, row + 0.5, color="#F4F4F6", linewidth=0, zorder=0)
    for row, (label, estimate, values) in enumerate(zip(labels, estimates, runs, strict=True)):
        axes.plot(
            values, np.full(len(values), row + 0.22), "o", color=label.color, markersize=3,
            alpha=0.45, markeredgewidth=0, zorder=2,
        )  # fmt: skip
        if estimate is None:
            axes.text(
                0.98, row - 0.04, absent[row], ha="right", va="center", color=MUTED, fontsize=8,
                transform=axes.get_yaxis_transform(), zorder=5,
            )  # fmt: skip
            continue
        ends = (estimate.low, estimate.high)
        axes.plot(ends, (row, row), color=label.color, linewidth=2.2, zorder=3)
        axes.plot(
            estimate.value, row, label.marker, color=label.color, markersize=7,
            markeredgecolor="white", markeredgewidth=0.8, zorder=4,
        )  # fmt: skip
    axes.set_ylim(len(labels) - 0.4, -0.6)
    axes.set_yticks(range(len(labels)), [label.name for label in labels])
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=True, axis="x")
    axes.spines[["top", "right", "left"]].set_visible(False)


def count_axis(axis: Axis, highest: float, *, smallest: float = 1.0) -> None:
    """Make an axis of counts logarithmic, and linear below some count, so that 0 is a place on it.

    Args:
        axis: The x or y axis of a panel.
        highest: The largest count to show.
        smallest: Where the logarithmic part starts, a power of ten.
    """
    first = round(np.log10(smallest))
    last = max(first + 1, int(np.ceil(np.log10(max(highest, smallest) * 1.05))))
    powers = range(first, last + 1, 1 if last - first <= 5 else 2)
    panel, vertical = axis.axes, isinstance(axis, YAxis)
    scale = panel.set_yscale if vertical else panel.set_xscale
    scale("symlog", linthresh=smallest, linscale=0.6)
    limits = panel.set_ylim if vertical else panel.set_xlim
    limits(-0.35 * smallest, 10.0**last)
    axis.set_major_locator(FixedLocator([0.0, *(10.0**power for power in powers)]))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(EngFormatter(sep="") if smallest >= 1 else StrMethodFormatter("{x:g}"))
    line = panel.axhline if vertical else panel.axvline
    line(0, color=INK, linewidth=0.8, zorder=1)


def step_axis(axes: Axes) -> None:
    """Name the horizontal axis of a training curve."""
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlabel("environment steps")
    axes.set_xlim(left=0)
    axes.grid(visible=True)
    axes.spines[["top", "right"]].set_visible(False)


def legend_below(figure: Figure, labels: Sequence[Label], *, columns: int = 4) -> None:
    """Name the methods below all panels."""
    entries = [
        Line2D([], [], color=label.color, marker=label.marker, markersize=6, linewidth=1.5,
               markeredgecolor="white", markeredgewidth=0.6, label=label.name)
        for label in labels
    ]  # fmt: skip
    figure.legend(handles=entries, loc="outside lower center", ncols=min(columns, len(entries)))


def spread_labels(
    axes: Axes, points: Sequence[tuple[float, float, Label]], *, gap: float = 0.062
) -> None:
    """Write each method's name beside its point, none over another.

    Args:
        axes: A panel with its final limits.
        points: X and y in data units, and the method.
        gap: The gap between two names, as a share of the panel's height.
    """
    to_share = axes.transData + axes.transAxes.inverted()
    places = [to_share.transform((x, y)) for x, y, _ in points]
    # About how wide a letter is, as a share of the panel: what is drawn is not known before.
    figure = axes.get_figure(root=True)
    assert figure is not None
    letter = 0.6 * _NAME_SIZE / 72 / figure.get_figwidth()
    # The marks themselves must stay readable too.
    taken: list[tuple[float, float, float]] = [(x - 0.015, x + 0.015, y) for x, y in places]
    for i in sorted(range(len(points)), key=lambda i: -places[i][1]):
        (x, level), label = places[i], points[i][2]
        side = -1 if x > 0.6 else 1
        near, far = sorted((x + 0.03 * side, x + (0.03 + letter * len(label.name)) * side))
        while any(
            abs(level - at) < gap and near < right and left < far for left, right, at in taken
        ):
            level -= gap / 8
        taken.append((near, far, level))
        axes.annotate(
            label.name, tuple(places[i]), (x + 0.03 * side, level), xycoords="axes fraction",
            ha="left" if side > 0 else "right", va="center", color=label.color,
            fontsize=_NAME_SIZE,
            arrowprops={"arrowstyle": "-", "color": MUTED, "linewidth": 0.5, "shrinkB": 5,
                        "relpos": (0.0 if side > 0 else 1.0, 0.5)},
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.75},
        )  # fmt: skip
