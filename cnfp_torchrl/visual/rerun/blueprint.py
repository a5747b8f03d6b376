"""The arrangement of the views, so that the first look tells the story."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import rerun.blueprint as rrb
from torchrl.envs import EnvBase
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.modules import flow_head
from cnfp_torchrl.visual.rerun import style
from cnfp_torchrl.visual.rerun.painters import HEIGHTS_IN_ONE, legend_size
from cnfp_torchrl.visual.rerun.style import (
    EXPLANATION,
    LEGEND,
    MAP,
    METRICS,
    SERIES,
    TIMELINE,
    stage_path,
)
from cnfp_torchrl.visual.setting import Setting, StageView

_STAGES_IN_LINE = 4
_STEPS_PER_SECOND = 8.0

TRAINING_PLOTS: Mapping[str, Sequence[str]] = {
    "Training: return": ["train/return"],
    "Training: losses": ["loss/**"],
    "Training: alpha": ["train/alpha"],
    "Training: entropy": ["train/entropy"],
    "Training: violations": ["violations/**"],
    "Training: relaxed and dropped": ["relaxed/**", "dropped/**"],
    "Training: largest relaxation": ["relaxation/**"],
}
"""What ``cnfp-train`` logs, with any loss."""


def flow_blueprint(
    actor: SafeProbabilisticTensorDictSequential,
    env: EnvBase | None = None,
    *,
    projections: Sequence[Sequence[int]] | None = None,
    training: Mapping[str, Sequence[str]] | None = None,
) -> rrb.Blueprint:
    """Return the arrangement of an actor's stream.

    The map stands on the left, where there is one, then the stages in order of application, a row
    for each projection, and the explanation; time series run below.

    Args:
        actor: as given to `FlowStream`.
        env: as given to `FlowStream`.
        projections: as given to `FlowStream`.
        training: titles of plots over training and the names of what is in them, as given to
            `RerunLogger`, such as `TRAINING_PLOTS`; None: none.
    """
    setting = Setting.of(flow_head(actor), env, projections)
    rows = [_row(setting, row) for row in setting.rows()]
    stages = rows[0] if len(rows) == 1 else rrb.Vertical(*rows)
    explanation = rrb.TextDocumentView(origin=f"/{EXPLANATION}", name="What happened in this step")
    if setting.view.map is None:
        beside = rrb.Vertical(explanation, _legend(setting), row_shares=[4, 1])
        above = rrb.Horizontal(stages, beside, column_shares=[2.5, 1])
    else:
        side = rrb.Vertical(_map(), _legend(setting), row_shares=[4.6, 1])
        beside = rrb.Vertical(stages, explanation, row_shares=[5, 3.8])
        above = rrb.Horizontal(side, beside, column_shares=[1, 2])
    plots = [rrb.Horizontal(*_episode(setting))]
    if training:
        plots.append(rrb.Horizontal(*(_metrics(*each) for each in training.items())))
    return rrb.Blueprint(
        rrb.Vertical(above, *plots, row_shares=[4.4] + [1.0] * len(plots)),
        rrb.TimePanel(
            state="collapsed", timeline=TIMELINE, play_state="following", fps=_STEPS_PER_SECOND
        ),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.TopPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _row(setting: Setting, row: list[StageView]) -> rrb.Container:
    """Return the stages from left to right, in lines of at most a few."""
    views = [_stage(setting, view) for view in row]
    lines = -(-len(views) // _STAGES_IN_LINE)
    return rrb.Grid(*views, grid_columns=-(-len(views) // lines))


def _map() -> rrb.Spatial2DView:
    return rrb.Spatial2DView(
        origin="/",
        contents=f"/{MAP}/**",
        name="Map",
        background=rrb.Background(color=style.BACKGROUND),
        # In half widths of the map, as it is drawn.
        visual_bounds=rrb.VisualBounds2D(x_range=[-1.04, 1.04], y_range=[-1.04, 1.04]),
    )


def _legend(setting: Setting) -> rrb.Spatial2DView:
    width, height = legend_size(setting)
    return rrb.Spatial2DView(
        origin="/",
        contents=f"/{LEGEND}",
        name="Legend",
        background=rrb.Background(color=style.BACKGROUND),
        visual_bounds=rrb.VisualBounds2D(x_range=[0, width], y_range=[0, height]),
    )


def _stage(setting: Setting, view: StageView) -> rrb.Spatial2DView:
    reach = setting.reach
    heights = [-reach, reach] if setting.dim > 1 else [-HEIGHTS_IN_ONE[1], -HEIGHTS_IN_ONE[0]]
    return rrb.Spatial2DView(
        origin="/",
        contents=f"/{stage_path(setting, view)}/**",
        name=view.title,
        background=rrb.Background(color=style.BACKGROUND),
        visual_bounds=rrb.VisualBounds2D(x_range=[-reach, reach], y_range=heights),
    )


def _episode(setting: Setting) -> list[rrb.TimeSeriesView]:
    views = [_series("reward", "Reward"), _series("return", "Return so far")]
    if setting.costs:
        views.append(_series("costs", "Violations so far", legend=True))
    views += [_series(each.name, each.title, span=each.limits) for each in setting.view.series]
    return [*views, _series("entropy", "Entropy (nats)")]


def _metrics(title: str, names: Sequence[str]) -> rrb.TimeSeriesView:
    contents = [f"/{METRICS}/{name}" for name in names]
    return rrb.TimeSeriesView(
        origin=f"/{METRICS}",
        contents=contents,
        name=title,
        plot_legend=rrb.PlotLegend("LeftTop", visible=True),
    )


def _series(
    name: str, title: str, *, legend: bool = False, span: tuple[float, float] | None = None
) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin=f"/{SERIES}/{name}",
        name=title,
        plot_legend=rrb.PlotLegend("LeftTop", visible=legend),
        axis_y=None if span is None else rrb.ScalarAxis(range=span),
    )
