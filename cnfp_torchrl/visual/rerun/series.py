"""Time series of an episode: what each plot shows, in which colors, and its values step by step."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import rerun as rr
from tensordict import TensorDictBase

from cnfp_torchrl.envs import Component
from cnfp_torchrl.keys import COST_KEY, OBSERVATION_KEY, REWARD_KEY
from cnfp_torchrl.visual.colors import curve_colors, rgb
from cnfp_torchrl.visual.rerun import entities, style
from cnfp_torchrl.visual.scene import Scene
from cnfp_torchrl.visual.setting import Setting

_METRICS_OF_EACH_CONSTRAINT = (
    "violations/",
    "evaluation/violations/",
    "train/lambda_",
    "relaxed/",
    "dropped/",
    "relaxation/",
)


@dataclass(frozen=True)
class Plot:
    """A plot over the steps of an episode.

    Args:
        name: The name of the entity, below ``series``.
        title: The title, with the unit.
        curves: The colors by the curves' names.
        limits: The limits of the upright axis; None fits it to the curves.
        is_apart: Whether each curve is an entity of its own, which may lack values of some steps.
    """

    name: str
    title: str
    curves: Mapping[str, style.Color]
    limits: tuple[float, float] | None = None
    is_apart: bool = False


def flow_plots(setting: Setting) -> list[Plot]:
    """Return the plots of what the constraints did, and of the policy's entropy."""
    plots = []
    constraints = {name: rgb(color) for name, color in setting.colors.items()}
    if setting.moves and constraints:
        plots.append(Plot("moved", f"Moved by ({setting.unit})", constraints, is_apart=True))
    if constraints:
        allowed = {"all constraints": style.PALE}
        plots.append(Plot("allowed", "Allowed before the flow (% of samples)", allowed, (0, 104)))
        title = f"Relaxed by ({setting.unit})"
        plots.append(Plot("relaxation", title, constraints, is_apart=True))
    if setting.costs:
        colors = {name: _constraint_color(setting, name) for name in setting.costs}
        plots.append(Plot("costs", "Violations so far (steps)", colors))
    return [*plots, Plot("entropy", "Entropy (nats)", {"entropy": style.SAMPLE})]


def task_plots(setting: Setting) -> list[Plot]:
    """Return the plots of reward, action, observation, and of what else the task shows."""
    plots = [
        Plot("reward", "Reward of a step", {"reward": style.REWARD}),
        Plot("return", "Return so far", {"return": style.PALE}),
    ]
    for series in setting.view.series:
        curves = {series.name: _constraint_color(setting, series.name)}
        if series.threshold is not None:
            curves["threshold"] = style.MUTED
        plots.append(Plot(f"task/{series.name}", series.title, curves, series.limits))
    plots.append(_component_plot("action", "Executed action", setting.components))
    if setting.observation:
        plots.append(_component_plot("observation", "Observation", setting.observation))
    return plots


class SeriesPainter:
    """Log the values of all plots.

    Args:
        stream: The stream to log to; names and colors are logged at once.
        setting: The setting, with the costs' names, the constraints' colors and the task's series.
    """

    def __init__(self, stream: rr.RecordingStream, setting: Setting) -> None:
        self._stream, self._setting = stream, setting
        self._plots = [*task_plots(setting), *flow_plots(setting)]
        self._return = 0.0
        self._costs = [0.0] * len(setting.costs)
        self._reward: float | None = None
        self._log_styles()

    def follow(self, transition: TensorDictBase) -> None:
        """Add a step to the sums; of every step, logged or not."""
        reward = transition.get(("next", REWARD_KEY), None)
        self._reward = None if reward is None else float(reward.sum())
        self._return += self._reward or 0.0
        cost = transition.get(("next", COST_KEY), None)
        if cost is not None and self._costs:
            self._costs = [a + b for a, b in zip(self._costs, cost.tolist(), strict=True)]

    def end_episode(self) -> None:
        """Begin the sums anew."""
        self._return, self._costs = 0.0, [0.0] * len(self._costs)

    def log(self, scene: Scene) -> None:
        """Log one step that was followed."""
        values = self._values(scene)
        for plot in self._plots:
            path = style.series_path(plot.name)
            given = values.get(plot.name, [])
            if plot.is_apart:
                for name, value in zip(plot.curves, given, strict=True):
                    if math.isfinite(value):
                        own = style.series_path(plot.name, name)
                        self._stream.log(own, entities.scalars([value]))
            elif given:
                self._stream.log(path, entities.scalars(given))

    def _values(self, scene: Scene) -> dict[str, Sequence[float]]:
        """Return the values of the plots by their names; what is not finite is not known."""
        snapshot, view = scene.snapshot, self._setting.view
        moved = [math.nan if x is None else x for x in scene.moved.values()]
        values: dict[str, Sequence[float]] = {
            "moved": moved,
            "allowed": [100 * snapshot.share_allowed_before],
            "relaxation": snapshot.relaxation[1:],
            "costs": self._costs,
            "entropy": [scene.entropy],
            "action": scene.explanation.action,
        }
        if self._reward is not None:
            values |= {"reward": [self._reward], "return": [self._return]}
        if self._setting.observation:
            values["observation"] = snapshot.state[OBSERVATION_KEY].tolist()
        if view.series:
            found = view.series_values(snapshot.state)
            for series in view.series:
                threshold = [] if series.threshold is None else [series.threshold]
                values[f"task/{series.name}"] = [float(found[series.name]), *threshold]
        return values

    def _log_styles(self) -> None:
        for plot in self._plots:
            for path, curves in _styled(plot).items():
                colors, names = list(curves.values()), list(curves)
                lines = rr.SeriesLines(colors=colors, names=names, widths=[2.0] * len(curves))
                self._stream.log(path, lines, static=True)
        for name, color in self._setting.colors.items():
            for metric in _METRICS_OF_EACH_CONSTRAINT:
                line = rr.SeriesLines(colors=rgb(color), names=name)
                path = rr.new_entity_path([style.METRICS, *f"{metric}{name}".split("/")])
                self._stream.log(path, line, static=True)


def _styled(plot: Plot) -> dict[str, Mapping[str, style.Color]]:
    """Return the curves of each of a plot's entities."""
    if not plot.is_apart:
        return {style.series_path(plot.name): plot.curves}
    return {style.series_path(plot.name, name): {name: c} for name, c in plot.curves.items()}


def _component_plot(name: str, title: str, components: Sequence[Component]) -> Plot:
    colors = curve_colors(len(components))
    names = [component.title for component in components]
    if len(names) == 1:
        title += f": {names[0]}"  # a single curve has no legend
    return Plot(name, title, dict(zip(names, colors, strict=True)))


def _constraint_color(setting: Setting, name: str) -> style.Color:
    """Return the color of the constraint of this name, or a muted one."""
    return rgb(setting.colors.get(name, "#8A8A8A"))
