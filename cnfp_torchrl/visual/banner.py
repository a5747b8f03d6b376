"""One wide picture of a flow, for a front page: samples on their way through the stages."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.tasks.point_nav import Layout
from cnfp_torchrl.visual.canvas import house_style
from cnfp_torchrl.visual.colors import INK, MUTED, constraint_colors
from cnfp_torchrl.visual.density import (
    CURVE,
    SPREAD,
    base_log_density,
    density_scale,
    draw_grid,
    draw_samples,
    grid_latents,
)
from cnfp_torchrl.visual.flow_stages import stage_grids
from cnfp_torchrl.visual.map_panel import draw_moves
from cnfp_torchrl.visual.outlines import region_outline, set_outline
from cnfp_torchrl.visual.snapshot import FlowSnapshot

_VIEW = (-1.12, 1.12, -1.12, 1.12)
_SIZE = (13.2, 3.3)
_LEFT, _WIDTH, _GAP, _BOTTOM, _HEIGHT = 0.014, 0.166, 0.0355, 0.11, 0.664
_COUNTED = 1_000_000


def flow_banner(
    snapshot: FlowSnapshot, layout: Layout, *, colors: Mapping[str, str] | None = None
) -> Figure:
    """Draw state, base and stages of an exact flow in one row, with arrows between them.

    The last caption counts violations among a million further samples.

    Args:
        snapshot: of an exact flow with two action components, in a state of point navigation.
        layout: its map.
        colors: of the constraints; None chooses them by name.
    """
    colors = dict(colors or constraint_colors(snapshot.constraint_names))
    scale, grids = density_scale(snapshot), stage_grids(snapshot)
    assert grids is not None
    with house_style():
        figure = Figure(figsize=_SIZE)
        panels = [_panel(figure, i) for i in range(2 + len(snapshot.stages))]
        draw_moves(panels[0], snapshot, layout, colors)
        panels[0].set(xticks=[], yticks=[], xlabel="", ylabel="", title="")
        _zoom(panels[0], snapshot, layout)
        _caption(panels[0], "the state", "where the agent may move")

        latents = grid_latents(snapshot)
        draw_grid(panels[1], latents, base_log_density(snapshot, latents), scale)
        _draw_web(panels[1], _web(snapshot))
        draw_samples(panels[1], snapshot.latents)
        reach = SPREAD * float(snapshot.scale.max())
        x, y = snapshot.loc.tolist()
        panels[1].set(xlim=(x - reach, x + reach), ylim=(y - reach, y + reach))
        _caption(panels[1], "base", "a Gaussian from any network")

        webs = snapshot.through_stages(_web(snapshot).reshape(-1, 2))[0]
        for i, (panel, stage) in enumerate(zip(panels[2:], snapshot.stages, strict=True)):
            draw_grid(panel, *grids[i], scale)
            _draw_web(panel, webs[i].reshape(*_web(snapshot).shape))
            draw_samples(panel, stage.samples)
            panel.plot(*region_outline(snapshot.region, (0,)).T, color=MUTED, linewidth=0.8)
            index = stage.applied[-1]
            if index > 0:
                for line in set_outline(snapshot.region.sets[index], _VIEW):
                    panel.plot(*line.T, color=colors[stage.name], linewidth=2.6, zorder=5)
            panel.plot(*region_outline(snapshot.region, stage.applied).T, color=INK, lw=1, zorder=6)
            panel.set(xlim=_VIEW[:2], ylim=_VIEW[2:])
            _caption(panel, *_stage_words(snapshot, i), color=colors.get(stage.name, INK))
        for i, word in enumerate(["", "tanh", *["retract"] * (len(panels) - 3)]):
            _arrow(figure, i, word)
        figure.text(
            0.5, 0.955, r"$\log\,\pi(a\,|\,s) \;=\; \log\,\mathcal{N}(z) \;-\; \log|\det|$"
            "   exactly, after every stage",
            ha="center", va="center", fontsize=12, color=INK,
        )  # fmt: skip
    return figure


def _zoom(axes: Axes, snapshot: FlowSnapshot, layout: Layout) -> None:
    """Show the agent and the nearest station."""
    agent = snapshot.state["observation"][:2]
    stations = torch.tensor(layout.stations).to(agent)
    nearest = stations[vector_norm(stations - agent, dim=-1).argmin()]
    middle = (agent + nearest) / 2
    reach = float((agent - nearest).abs().max()) / 2 + 2 * layout.step_length
    (x, y), wall = middle.tolist(), 1.02 * layout.wall
    x, y = (min(max(each, reach - wall), wall - reach) for each in (x, y))
    axes.set(xlim=(x - reach, x + reach), ylim=(y - reach, y + reach))


def _stage_words(snapshot: FlowSnapshot, index: int) -> tuple[str, str]:
    stage = snapshot.stages[index]
    if stage.applied[-1] == 0:
        return "action bounds", "tanh, as in any SAC"
    if index + 1 < len(snapshot.stages):
        return stage.name, "retracted into its set"
    broken = _violations(snapshot)
    return stage.name, f"{broken:,} of {_COUNTED:,} actions break a rule"


def _violations(snapshot: FlowSnapshot) -> int:
    """Count, with zero tolerance, actions of fresh samples that break any active constraint."""
    generator = torch.Generator().manual_seed(1)
    broken = 0
    for _ in range(_COUNTED // 100_000):
        noise = torch.randn(100_000, snapshot.dim, generator=generator)
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


def _caption(axes: Axes, head: str, words: str, *, color: str = INK) -> None:
    axes.text(
        0.5, 1.07, head, transform=axes.transAxes, ha="center", va="center", fontsize=12,
        fontweight="bold", color=color,
    )  # fmt: skip
    axes.text(0.5, -0.09, words, transform=axes.transAxes, ha="center", va="center", fontsize=10)


def _arrow(figure: Figure, after: int, word: str) -> None:
    start = _LEFT + (after + 1) * _WIDTH + after * _GAP
    middle = _BOTTOM + _HEIGHT / 2
    arrow = FancyArrowPatch(
        (start + 0.003, middle), (start + _GAP - 0.003, middle), transform=figure.transFigure,
        arrowstyle="-|>", mutation_scale=16, color=INK, linewidth=1.6,
    )  # fmt: skip
    figure.add_artist(arrow)
    figure.text(start + _GAP / 2, middle + 0.055, word, ha="center", fontsize=9.5, color=INK)
