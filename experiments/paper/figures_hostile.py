"""Violations of hostile networks behind each flow."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from cnfp_torchrl.visual.comparison import count_axis, draw_estimates, draw_rows_apart
from cnfp_torchrl.visual.figures.canvas import house_style, new_figure
from experiments.paper.hostile import HostileRun, by_flow
from experiments.paper.labels import in_order, label


def draw_hostile(runs: Sequence[HostileRun]) -> Figure:
    """Draw, for each flow and constraint, the violations per million steps of each network."""
    flows = by_flow(runs)
    names = in_order(flows)
    constraints = list(runs[0].violations)
    highest = max(_rate(run, constraint) for run in runs for constraint in constraints)
    with house_style():
        figure = new_figure(5.6 * len(constraints), 0.55 * len(names) + 1.2)
        for i, constraint in enumerate(constraints):
            axes = figure.add_subplot(1, len(constraints), 1 + i)
            axes.set_title(f"{constraint}: violating steps per million, one dot a network")
            rates = [[_rate(run, constraint) for run in flows[name]] for name in names]
            said = [
                f"{sum(run.violations[constraint] for run in flows[name]):,} in "
                f"{sum(run.steps for run in flows[name]):,} steps"
                for name in names
            ]
            draw_rows_apart(axes, len(names))
            draw_estimates(
                axes, [label(name).look for name in names], [None] * len(names), rates, absent=said
            )
            count_axis(axes.xaxis, highest)
            if i:
                axes.set_yticklabels([])
    return figure


def _rate(run: HostileRun, constraint: str) -> float:
    return 1e6 * run.violations[constraint] / run.steps
