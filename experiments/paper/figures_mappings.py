"""The mappings of the paper's second figure, and those beyond it: particles before and after."""

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

from cnfp_torchrl.bijectors import (
    BallSquash,
    Bijector,
    BoxSquash,
    EllipsoidSquash,
    GaugeSquash,
    Retraction,
    ShellSquash,
    SquashChain,
)
from cnfp_torchrl.geometry import (
    Ball,
    Box,
    ConstraintSet,
    Ellipsoid,
    HalfSpaces,
    PositivePart,
    Region,
    VisibleRegion,
    WeightedL1Ball,
)
from cnfp_torchrl.visual.colors import FAINT, INK, MUTED
from cnfp_torchrl.visual.figures.canvas import house_style, new_figure
from cnfp_torchrl.visual.outlines import Line, View, region_outline, set_outline

COLOR = "#E69F00"
"""Of the sets."""

PARTICLES = "cividis"
"""Colors of particles by their distance from the origin: even with any color vision."""

_VIEW = (-1.15, 1.15, -1.15, 1.15)
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
        title: The title above its panel.
        bijector: The bijector from the plane.
        outlines: The outlines of the set that it maps onto, closed; a hole's runs the other way
            round.
        context: Further outlines, such as those of the action bounds.
        first: A bijection after which the particles' ways are drawn, for a stage that does not
            start from the Gaussian itself.
    """

    title: str
    bijector: Bijector
    outlines: Sequence[Line]
    context: Sequence[Line] = ()
    first: Bijector | None = None


def t(values: object) -> Tensor:
    """Return a tensor in double precision."""
    return torch.tensor(values, dtype=torch.float64)


BOUNDS = Box(t([-1.0, -1.0]), t([1.0, 1.0]))


def mapping_examples() -> list[MappingExample]:
    """Return each family of mappings once: the paper's three, then those of this library."""
    box = Box(t([-0.9, -0.5]), t([0.6, 0.8]))
    ball = Ball(t([0.2, -0.1]), t(0.75))
    ellipsoid = Ellipsoid(t([0.0, 0.0]), t([[0.85, 0.0], [0.45, 0.5]]))
    corner = HalfSpaces(t([[1.0, 0.6], [-0.4, 1.0], [0.1, -1.0]]), t([0.55, 0.6, 0.7]))
    seen = VisibleRegion(t([0.0, 0.0]), t([[[0.25, 0.1], [0.55, 0.45]]]), t(1.0))
    return [
        _onto("box squash", BoxSquash(box.low, box.high), box),
        _onto("ball squash", BallSquash(ball.center, ball.radius), ball),
        _onto(
            "ellipsoid squash", EllipsoidSquash(ellipsoid.center, ellipsoid.scale_tril), ellipsoid
        ),
        _retraction(ball),
        _flow("half-spaces", corner),
        _flow("weighted L1 ball", WeightedL1Ball(t([1.0, 1.5]), t(0.9))),
        _flow("positive part", PositivePart(t([1.0, -1.2]), t(0.6))),
        _flow("visible region", seen),
        _shell(),
    ]


@torch.no_grad()
def draw_mappings(examples: Sequence[MappingExample] | None = None) -> Figure:
    """Draw the same particles and the same square web before and after each bijection.

    A particle keeps its color, which tells how far from the origin it started; where a bijection
    tears the plane, lines of the web end.

    Args:
        examples: One for each panel, after the first panel, which shows the Gaussian; None draws
            `mapping_examples`.
    """
    examples = mapping_examples() if examples is None else examples
    generator = torch.Generator().manual_seed(0)
    latents = torch.randn(_COUNT, 2, generator=generator, dtype=torch.float64)
    scale = Normalize(0, _FARTHEST)
    columns = min(_COLUMNS, 1 + len(examples))
    rows = -(-(1 + len(examples)) // columns)
    with house_style():
        figure = new_figure(2.3 * columns + 0.8, 2.45 * rows)
        panels = [figure.add_subplot(rows, columns, 1 + i) for i in range(1 + len(examples))]
        _draw_web(panels[0], _web())
        _draw_particles(panels[0], latents, latents, scale)
        panels[0].set_title("before: z ~ N(0, I)", color=INK)
        _frame(panels[0], (-3.4, 3.4, -3.4, 3.4))
        for panel, example in zip(panels[1:], examples, strict=True):
            area = Path.make_compound_path(*(Path(line, closed=True) for line in example.outlines))
            panel.add_patch(PathPatch(area, facecolor=COLOR, linewidth=0, alpha=0.16, zorder=0))
            for line in example.outlines:
                panel.plot(*line.T, color=COLOR, linewidth=1.8, zorder=4)
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
            _frame(panel, _VIEW)
        bar = figure.colorbar(
            ScalarMappable(scale, PARTICLES), ax=panels, shrink=0.6, aspect=30, extend="max"
        )
        bar.set_label("|z| before")
        bar.outline.set_visible(False)
    return figure


def _onto(title: str, bijector: Bijector, image: ConstraintSet) -> MappingExample:
    return MappingExample(title, bijector, set_outline(image, _VIEW))


def _retraction(ball: Ball) -> MappingExample:
    squash = BoxSquash(BOUNDS.low, BOUNDS.high)
    chain = SquashChain([squash, Retraction(BOUNDS, ball, ball.center)])
    return MappingExample(
        "retraction of the bounds", chain, set_outline(ball, _VIEW), _bounds(), first=squash
    )


def _flow(title: str, constraint: ConstraintSet) -> MappingExample:
    """Return the exact flow into the action bounds and one constraint."""
    region = Region.build([BOUNDS, constraint])
    outline = region_outline(region, (0, 1))
    return MappingExample(title, GaugeSquash(region), [outline], _bounds())


def _shell() -> MappingExample:
    center, inner, outer = t([0.0, 0.0]), t(0.35), t(0.95)
    (hole,), (rim,) = (set_outline(Ball(center, radius), _VIEW) for radius in (inner, outer))
    return MappingExample("shell squash", ShellSquash(center, inner, outer), [rim, hole[::-1]])


def _bounds() -> list[Line]:
    return [region_outline(Region((BOUNDS,), torch.zeros_like(BOUNDS.low)), (0,))]


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
