"""The arrangement of the views, so that the first look tells the story."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import rerun.blueprint as rrb
from torchrl.envs import EnvBase
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.envs import can_render
from cnfp_torchrl.modules import flow_head
from cnfp_torchrl.visual.rerun import style
from cnfp_torchrl.visual.rerun.painters import HEIGHTS_IN_ONE, axis_room, legend_size
from cnfp_torchrl.visual.rerun.series import Plot, flow_plots, task_plots
from cnfp_torchrl.visual.rerun.style import (
    EXPLANATION,
    LEGEND,
    MAP,
    METRICS,
    PICTURE,
    TIMELINE,
    series_path,
    stage_path,
)
from cnfp_torchrl.visual.setting import Setting, StageView

_STAGES_IN_LINE = 4
_ROWS_AT_ONCE = 3
_MOST_IN_LEGEND = 8
_STEPS_PER_SECOND = 8.0

TRAINING_PLOTS: Mapping[str, Sequence[str]] = {
    "Return": ["train/return", "evaluation/return"],
    "Losses": ["loss/**"],
    "Alpha": ["train/alpha"],
    "Entropy": ["train/entropy"],
    "Violating steps": ["violations/**"],
    "… in an evaluation": ["evaluation/violations/**"],
    "Relaxed, dropped": ["relaxed/**", "dropped/**"],
    "Largest relaxation": ["relaxation/**"],
}
"""What ``cnfp-train`` logs, with any loss: titles that a tab of eight has room for."""


def flow_blueprint(
    actor: SafeProbabilisticTensorDictSequential,
    env: EnvBase | None = None,
    *,
    projections: Sequence[Sequence[int]] | None = None,
    training: Mapping[str, Sequence[str]] | None = None,
    timeline: str = TIMELINE,
) -> rrb.Blueprint:
    """Return the arrangement of an actor's stream.

    The environment's picture and map stand on the left, where there are such, then the stages in
    order of application, a row for each projection, and the explanation. Below run the plots of
    what the constraints did, of the task, and of the training, with one time axis for all.

    Args:
        actor: The actor as given to `FlowStream`.
        env: The environment as given to `FlowStream`.
        projections: The projections as given to `FlowStream`.
        training: The titles of plots over training and the names of what is in them, as given to
            `RerunLogger`, such as `TRAINING_PLOTS`; None: none.
        timeline: The timeline that is shown first.
    """
    setting = Setting.of(flow_head(actor), env, projections)
    explanation = rrb.TextDocumentView(origin=f"/{EXPLANATION}", name="What happened in this step")
    views = [_map()] if setting.view.map else [_picture()] if can_render(env) else [explanation]
    side = rrb.Vertical(*views, _legend(setting), row_shares=[4.6, 1])
    stages = _stages(setting)
    if views[0] is not explanation:
        # More rows of stages leave less room for words.
        shares = [5, 3.8] if len(setting.rows()) == 1 else [5, 2.2]
        stages = rrb.Vertical(stages, explanation, row_shares=shares)
    above = rrb.Horizontal(side, stages, column_shares=[1, 2])
    task: rrb.Container = rrb.Horizontal(*map(_plot, task_plots(setting)), name="Task")
    if training:
        metrics = (_metrics(*titled) for titled in training.items())
        task = rrb.Tabs(task, rrb.Horizontal(*metrics, name="Training"))
    flow = rrb.Horizontal(*map(_plot, flow_plots(setting)), name="Constraints")
    return rrb.Blueprint(
        rrb.Vertical(above, flow, task, row_shares=[5, 1, 1.2]),
        rrb.TimePanel(
            state="collapsed", timeline=timeline, play_state="following", fps=_STEPS_PER_SECOND
        ),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.TopPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _stages(setting: Setting) -> rrb.Container:
    """Return a row of views for each projection; of many, some at a time."""
    rows, pages = setting.rows(), []
    for first in range(0, len(rows), _ROWS_AT_ONCE):
        shown = rows[first : first + _ROWS_AT_ONCE]
        name = " · ".join(setting.names(row[0].components) for row in shown)
        pages.append(rrb.Vertical(*(_row(setting, row) for row in shown), name=name))
    return pages[0] if len(pages) == 1 else rrb.Tabs(*pages)


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
        visual_bounds=rrb.VisualBounds2D(x_range=[-1.04, 1.04], y_range=_with_axes([-1.04, 1.04])),
    )


def _picture() -> rrb.Spatial2DView:
    return rrb.Spatial2DView(origin=f"/{PICTURE}", name="Environment")


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
        visual_bounds=rrb.VisualBounds2D(
            x_range=[-reach, reach], y_range=_with_axes(heights, len(setting.rows()))
        ),
    )


def _with_axes(heights: Sequence[float], rows: int = 1) -> list[float]:
    """Return heights, from the top, with room for the axes' titles above and below."""
    room = axis_room(rows)
    return [heights[0] - room, heights[1] + room]


def _plot(plot: Plot) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin=f"/{series_path(plot.name)}",
        name=plot.title,
        plot_legend=rrb.PlotLegend("LeftTop", visible=1 < len(plot.curves) <= _MOST_IN_LEGEND),
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        axis_y=None if plot.limits is None else rrb.ScalarAxis(range=plot.limits),
    )


def _metrics(title: str, names: Sequence[str]) -> rrb.TimeSeriesView:
    contents = [f"/{METRICS}/{name}" for name in names]
    return rrb.TimeSeriesView(
        origin=f"/{METRICS}",
        contents=contents,
        name=title,
        plot_legend=rrb.PlotLegend("LeftTop", visible=True),
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
    )
