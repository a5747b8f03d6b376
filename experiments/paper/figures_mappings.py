"""The mappings of the paper's second figure, and those beyond it."""

from __future__ import annotations

import torch
from matplotlib.figure import Figure
from torch import Tensor

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
from cnfp_torchrl.visual.mappings import MappingExample, mappings
from cnfp_torchrl.visual.outlines import Line, region_outline, set_outline

COLOR = "#E69F00"
_VIEW = (-1.15, 1.15, -1.15, 1.15)


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


def draw_mappings() -> Figure:
    """Draw `mapping_examples`."""
    return mappings(mapping_examples(), color=COLOR, view=_VIEW)


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
