"""Draw the front page's picture of a flow: `python experiments/figures/banner.py OUT.png`."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch
from torch import Tensor, nn
from torchrl.envs import EnvBase

from cnfp_torchrl import constrain_env
from cnfp_torchrl.envs import Marks
from cnfp_torchrl.modules import make_constrained_actor
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, Layout, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.visual import FlowSnapshot, Scene, Setting, take_snapshot
from cnfp_torchrl.visual.colors import INK, MUTED
from cnfp_torchrl.visual.figures.canvas import house_style, save_png
from cnfp_torchrl.visual.figures.map import draw_moves
from cnfp_torchrl.visual.figures.stages import (
    CURVE,
    SPREAD,
    draw_base,
    draw_density,
    draw_samples,
)
from cnfp_torchrl.visual.scene import PRINTED, Detail, density_limits

ORDER = ["battery", "obstacle"]
LAYOUT = Layout(
    rectangles=((-0.6, -0.6, -0.2, -0.3), (0.1, -0.2, 0.5, 0.5), (-0.5, 0.2, -0.3, 0.8)),
    stations=((-0.9, 0.0), (0.8, 0.8)),
)
# Beside a rectangle, at its corner, with just enough charge to reach the station.
POSITION, BATTERY, GOAL = (0.47, -0.22), 34, (0.6, 0.2)
DPI = 116

_VIEW = (-1.12, 1.12, -1.12, 1.12)
_SIZE = (13.2, 3.3)
_LEFT, _WIDTH, _GAP, _BOTTOM, _HEIGHT = 0.014, 0.166, 0.0355, 0.11, 0.664


def flow_banner(
    snapshot: FlowSnapshot,
    env: EnvBase,
    *,
    colors: Mapping[str, str] | None = None,
    detail: Detail = PRINTED,
    counted: int = 1_000_000,
) -> Figure:
    """Draw state, base and stages of an exact flow in one row, with arrows between them.

    The last caption counts violations among many further samples.

    Args:
        snapshot: The snapshot of an exact flow with two action components.
        env: The environment of a task with a map.
        colors: The colors of the constraints; None chooses them by name.
        detail: How fine.
        counted: The number of the further samples.
    """
    scene, plane = (
        Scene(Setting.of(snapshot.head, env).holding(snapshot), snapshot, detail),
        (0, 1),
    )
    assert scene.log_density is not None
    colors = dict(colors or scene.setting.colors)
    limits = Normalize(*density_limits(snapshot))
    with house_style():
        figure = Figure(figsize=_SIZE)
        panels = [_panel(figure, i) for i in range(2 + len(snapshot.stages))]
        draw_moves(panels[0], scene, colors)
        panels[0].set(xticks=[], yticks=[], xlabel="", ylabel="", title="")
        _zoom(panels[0], scene)
        _caption(panels[0], "the state", "where the agent may move")

        draw_base(panels[1], snapshot, limits, detail.cells)
        _draw_web(panels[1], _web(snapshot))
        reach = SPREAD * float(snapshot.scale.max())
        x, y = snapshot.loc.tolist()
        panels[1].set(
            xlim=(x - reach, x + reach), ylim=(y - reach, y + reach), xticks=[], yticks=[]
        )
        _caption(panels[1], "base", "a Gaussian from any network")

        webs = snapshot.through_stages(_web(snapshot).reshape(-1, 2))[0]
        for i, (panel, stage) in enumerate(zip(panels[2:], snapshot.stages, strict=True)):
            draw_density(panel, scene.actions, scene.log_density[i], limits)
            _draw_web(panel, webs[i].reshape(*_web(snapshot).shape))
            draw_samples(panel, stage.samples)
            for line in scene.set_lines(0, plane):
                panel.plot(*line.T, color=MUTED, linewidth=0.8)
            index = stage.applied[-1]
            if index > 0:
                for line in scene.set_lines(index, plane) or scene.dropped_lines(index, plane):
                    panel.plot(*line.T, color=colors[stage.name], linewidth=2.6, zorder=5)
            for line in scene.allowed_lines(i, plane):
                panel.plot(*line.T, color=INK, lw=1, zorder=6)
            panel.set(xlim=_VIEW[:2], ylim=_VIEW[2:])
            captions = _stage_captions(snapshot, i, counted)
            _caption(panel, *captions, color=colors.get(stage.name, INK))
        for i, word in enumerate(["", "tanh", *["retract"] * (len(panels) - 3)]):
            _arrow(figure, i, word)
        figure.text(
            0.5, 0.955, r"$\log\,\pi(a\,|\,s) \;=\; \log\,\mathcal{N}(z) \;-\; \log|\det|$"
            "   exactly, after every stage",
            ha="center", va="center", fontsize=12, color=INK,
        )  # fmt: skip
    return figure


def _zoom(axes: Axes, scene: Scene) -> None:
    """Show the agent and the nearest of the places that are marked on the map."""
    view, plane = scene.setting.view, scene.setting.view.map
    assert plane is not None
    agent = view.position(scene.snapshot.state).numpy()
    marked = [shape.points for shape in plane.shapes if isinstance(shape, Marks)]
    places = np.concatenate([*map(np.array, marked), agent[None]][: max(len(marked), 1)])
    nearest = places[np.linalg.norm(places - agent, axis=-1).argmin()]
    reach = float(np.abs(agent - nearest).max()) / 2 + 2 * (plane.step_length or 0.0)
    limits = []
    for middle, (low, high) in zip((agent + nearest) / 2, (plane.x, plane.y), strict=True):
        margin = 0.01 * (high - low)
        middle = min(max(middle, low - margin + reach), high + margin - reach)
        limits.append((middle - reach, middle + reach))
    axes.set(xlim=limits[0], ylim=limits[1])


def _stage_captions(snapshot: FlowSnapshot, index: int, counted: int) -> tuple[str, str]:
    stage = snapshot.stages[index]
    if stage.applied[-1] == 0:
        return "action bounds", "tanh, as in any SAC"
    if index + 1 < len(snapshot.stages):
        return stage.name, "retracted into its set"
    return stage.name, f"{_violations(snapshot, counted):,} of {counted:,} actions break a rule"


def _violations(snapshot: FlowSnapshot, counted: int) -> int:
    """Count, with zero tolerance, actions of fresh samples that break any active constraint."""
    generator = torch.Generator().manual_seed(1)
    broken = 0
    for first in range(0, counted, 100_000):
        size = min(100_000, counted - first)
        noise = torch.randn(size, snapshot.dim, generator=generator)
        actions, _ = snapshot.through_stages(snapshot.loc + snapshot.scale * noise)
        broken += int((~snapshot.region.contains(actions[-1])).sum())
    return broken


def _web(snapshot: FlowSnapshot) -> Tensor:
    """Return lines of a square net over the base, ``(lines, points, 2)``."""
    along = torch.linspace(-SPREAD, SPREAD, 401)
    across = torch.linspace(-2.4, 2.4, 13)
    one, other = torch.meshgrid(across, along, indexing="ij")
    lines = torch.cat([torch.stack([one, other], -1), torch.stack([other, one], -1)])
    return snapshot.loc + snapshot.scale * lines


def _draw_web(axes: Axes, lines: Tensor) -> None:
    web = LineCollection(list(lines.numpy()), colors=CURVE, linewidths=0.6, alpha=0.85, zorder=2)
    axes.add_collection(web, autolim=False)


def _panel(figure: Figure, column: int) -> Axes:
    axes = figure.add_axes((_LEFT + column * (_WIDTH + _GAP), _BOTTOM, _WIDTH, _HEIGHT))
    axes.set_aspect("equal")
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    return axes


def _caption(axes: Axes, head: str, below: str, *, color: str = INK) -> None:
    axes.text(
        0.5, 1.07, head, transform=axes.transAxes, ha="center", va="center", fontsize=12,
        fontweight="bold", color=color,
    )  # fmt: skip
    axes.text(0.5, -0.09, below, transform=axes.transAxes, ha="center", va="center", fontsize=10)


def _arrow(figure: Figure, after: int, word: str) -> None:
    start = _LEFT + (after + 1) * _WIDTH + after * _GAP
    middle = _BOTTOM + _HEIGHT / 2
    arrow = FancyArrowPatch(
        (start + 0.003, middle), (start + _GAP - 0.003, middle), transform=figure.transFigure,
        arrowstyle="-|>", mutation_scale=16, color=INK, linewidth=1.6,
    )  # fmt: skip
    figure.add_artist(arrow)
    figure.text(start + _GAP / 2, middle + 0.055, word, ha="center", fontsize=9.5, color=INK)


class StandardNormal(nn.Module):
    """The base of a network that has learned nothing yet."""

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return location 0 and scale 1."""
        shape = (*observation.shape[:-1], 2)
        return torch.zeros(shape), torch.ones(shape)


def main(path: Path) -> None:
    """Draw an untrained policy in a state where both constraints bind."""
    env = constrain_env(
        PointNavEnv(layout=LAYOUT, seed=0),
        BatteryGeometry(LAYOUT),
        ObstacleGeometry(LAYOUT),
        order=ORDER,
    )
    actor = make_constrained_actor(StandardNormal(), env)
    state = env.reset(position=POSITION, battery=BATTERY, goal=GOAL)
    snapshot = take_snapshot(actor, state, samples=700)
    save_png(flow_banner(snapshot, env), path, dpi=DPI)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python experiments/figures/banner.py OUT.png")
    main(Path(sys.argv[1]))
