"""What bijections into sets do to particles of a Gaussian, before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.bijectors import Bijector
from cnfp_torchrl.visual.colors import FAINT, INK, MUTED
from cnfp_torchrl.visual.figures.canvas import house_style, new_figure
from cnfp_torchrl.visual.outlines import Line, View

PARTICLES = "cividis"
"""Colors of particles by their distance from the origin: even with any color vision."""

_COUNT = 320
_FARTHEST = 3.0
_WEB_REACH, _WEB_LINES, _WEB_NODES = 2.4, 13, 601
_TEAR = 0.06
"""Neighbors on a line of the web that land farther apart than this lie on two sides of a tear."""
_COLUMNS = 5


@dataclass(frozen=True)
class MappingExample:
    """A bijection to draw.

    Args:
        title: above its panel.
        bijector: from the plane.
        outlines: of the set that it maps onto, closed; a hole's runs the other way round.
        context: further outlines, such as those of the action bounds.
        first: a bijection after which the particles' ways are drawn, for a stage that does not
            start from the Gaussian itself.
    """

    title: str
    bijector: Bijector
    outlines: Sequence[Line]
    context: Sequence[Line] = ()
    first: Bijector | None = None


@torch.no_grad()
def mappings(
    examples: Sequence[MappingExample],
    *,
    color: str,
    view: View = (-1.15, 1.15, -1.15, 1.15),
    title: str = "",
) -> Figure:
    """Draw the same particles and the same square web before and after each bijection.

    A particle keeps its color, which tells how far from the origin it started; where a bijection
    tears the plane, lines of the web end.

    Args:
        examples: one for each panel, after the first panel, which shows the Gaussian.
        color: of the sets.
        view: limits of all panels but the first.
        title: above the panels; none by default.
    """
    generator = torch.Generator().manual_seed(0)
    latents = torch.randn(_COUNT, 2, generator=generator, dtype=torch.float64)
    scale = Normalize(0, _FARTHEST)
    columns = min(_COLUMNS, 1 + len(examples))
    rows = -(-(1 + len(examples)) // columns)
    with house_style():
        figure = new_figure(2.3 * columns + 0.8, 2.45 * rows + (0.35 if title else 0))
        if title:
            figure.suptitle(title)
        panels = [figure.add_subplot(rows, columns, 1 + i) for i in range(1 + len(examples))]
        _draw_web(panels[0], _web())
        _draw_particles(panels[0], latents, latents, scale)
        panels[0].set_title("before: z ~ N(0, I)", color=INK)
        _frame(panels[0], (-3.4, 3.4, -3.4, 3.4))
        for panel, example in zip(panels[1:], examples, strict=True):
            area = Path.make_compound_path(*(Path(line, closed=True) for line in example.outlines))
            panel.add_patch(PathPatch(area, facecolor=color, linewidth=0, alpha=0.16, zorder=0))
            for line in example.outlines:
                panel.plot(*line.T, color=color, linewidth=1.8, zorder=4)
            for line in example.context:
                panel.plot(*line.T, color=MUTED, linewidth=0.9, linestyle=(0, (4, 2)), zorder=3)
            _draw_web(panel, example.bijector.forward_and_log_det(_web())[0])
            mapped, _ = example.bijector.forward_and_log_det(latents)
            if example.first is not None:
                before, _ = example.first.forward_and_log_det(latents)
                ways = torch.stack([before, mapped], dim=1).numpy()
                panel.add_collection(
                    LineCollection(list(ways), colors=INK, linewidths=0.5, alpha=0.5, zorder=4),
                    autolim=False,
                )
            _draw_particles(panel, latents, mapped, scale)
            panel.set_title(example.title)
            _frame(panel, view)
        bar = figure.colorbar(
            ScalarMappable(scale, PARTICLES), ax=panels, shrink=0.6, aspect=30, extend="max"
        )
        bar.set_label("|z| before")
        bar.outline.set_visible(False)
    return figure


def _web() -> Tensor:
    """Return lines of a square net over the plane, ``(lines, points, 2)``."""
    across = torch.linspace(-_WEB_REACH, _WEB_REACH, _WEB_LINES, dtype=torch.float64)
    # An offset from the origin, where a shell is torn and its direction undefined.
    along = torch.linspace(-_FARTHEST, _FARTHEST, _WEB_NODES, dtype=torch.float64) + 1e-6
    one, other = torch.meshgrid(across, along, indexing="ij")
    return torch.cat([torch.stack([one, other], -1), torch.stack([other, one], -1)])


def _draw_web(axes: Axes, lines: Tensor) -> None:
    torn = vector_norm(lines.diff(dim=1), dim=-1) > _TEAR
    pieces = [
        piece
        for line, tears in zip(lines, torn, strict=True)
        for piece in _split(line, tears)
        if len(piece) > 1
    ]
    web = LineCollection(pieces, colors=MUTED, linewidths=0.5, alpha=0.8, zorder=2)
    axes.add_collection(web, autolim=False)


def _split(line: Tensor, tears: Tensor) -> list[Line]:
    ends = [0, *(tears.nonzero().flatten() + 1).tolist(), len(line)]
    return [line[start:end].numpy() for start, end in pairwise(ends)]


def _draw_particles(axes: Axes, latents: Tensor, places: Tensor, scale: Normalize) -> None:
    x, y = places.numpy().T
    colors = vector_norm(latents, dim=-1).numpy()
    axes.scatter(
        x, y, c=colors, cmap=PARTICLES, norm=scale, s=9, linewidths=0.3, edgecolors="white",
        zorder=5,
    )  # fmt: skip


def _frame(axes: Axes, view: View) -> None:
    axes.set(xlim=view[:2], ylim=view[2:], xticks=[], yticks=[])
    axes.set_aspect("equal")
    axes.spines[:].set_color(FAINT)
