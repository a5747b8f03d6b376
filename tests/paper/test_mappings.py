"""Particles before and after mappings."""

import torch
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from cnfp_torchrl.bijectors import BallSquash, BoxSquash, ShellSquash
from cnfp_torchrl.geometry import Ball
from cnfp_torchrl.visual.outlines import set_outline
from experiments.paper.figures_mappings import MappingExample, draw_mappings, mapping_examples
from tests.pictures import draws

ZERO, VIEW = torch.zeros(2, dtype=torch.float64), (-1.2, 1.2, -1.2, 1.2)
RADIUS = torch.tensor(0.8, dtype=torch.float64)


def webs(figure: Figure, panel: int) -> int:
    """Return of how many pieces the web in a panel is."""
    axes = figure.axes[panel]
    web = next(
        collection for collection in axes.collections if isinstance(collection, LineCollection)
    )
    return len(web.get_segments())


def test_particles_land_in_the_set() -> None:
    ball = Ball(ZERO, RADIUS)
    box = BoxSquash(ZERO - 0.5, ZERO + 0.5)
    examples = [
        MappingExample("ball", BallSquash(ZERO, RADIUS), set_outline(ball, VIEW)),
        MappingExample("box", box, (), first=box),
        MappingExample("shell", ShellSquash(ZERO, RADIUS / 4, RADIUS), set_outline(ball, VIEW)),
    ]
    figure = draw_mappings(examples)
    titles = [axes.get_title() for axes in figure.axes[:4]]
    assert titles == ["before: z ~ N(0, I)", "ball", "box", "shell"]
    before, *after = (axes.collections[-1].get_offsets() for axes in figure.axes[:4])
    assert len({len(shown) for shown in (before, *after)}) == 1
    assert ball.contains(torch.as_tensor(after[0])).all()
    assert (torch.as_tensor(after[2]).norm(dim=-1) > RADIUS / 4).all()
    # The shell tears the lines through the origin; the others tear none.
    assert webs(figure, 0) == webs(figure, 1) == webs(figure, 2) < webs(figure, 3)
    assert draws(figure)


def test_each_family_is_drawn_once() -> None:
    titles = [example.title for example in mapping_examples()]
    assert titles[:4] == [
        "box squash", "ball squash", "ellipsoid squash", "retraction of the bounds",
    ]  # fmt: skip
    assert len(titles) == len(set(titles)) == 9
