"""Fields of every size that the dtype holds: the search and the flows come out right, or refuse."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from cnfp_torchrl.bijectors import ExactSquash, RadialSquash
from cnfp_torchrl.geometry import (
    Ball,
    Box,
    ConstraintSet,
    Ellipsoid,
    GeometryError,
    HalfSpaces,
    PositivePart,
    Region,
    TaskSpaceBall,
    VisibleRegion,
    WeightedL1Ball,
)

DECADES = {torch.float32: 30.0, torch.float64: 140.0}
COUNT, DIM = 40, 2


class Draw:
    """Numbers whose logarithm is uniform over the decades of a dtype."""

    def __init__(self, dtype: torch.dtype, seed: int) -> None:
        self.dtype = dtype
        self.random = torch.Generator().manual_seed(seed)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(COUNT, *shape, generator=self.random, dtype=torch.float64)

    def size(self, decades: float | None = None) -> Tensor:
        exponent = 2 * torch.rand(COUNT, generator=self.random, dtype=torch.float64) - 1
        return 10.0 ** (exponent * (DECADES[self.dtype] if decades is None else decades))

    def __call__(self, *shape: int, decades: float | None = None) -> Tensor:
        """Return values of one size for each of the sets, ``(COUNT, *shape)``."""
        size = self.size(decades).reshape(COUNT, *(1,) * len(shape))
        return (self.normal(*shape) * size).to(self.dtype)


def ellipsoid(draw: Draw) -> Ellipsoid:
    # One size for the whole matrix: axes of very different sizes are refused.
    shape = draw.normal(DIM, DIM).tril(-1) + torch.diag_embed(0.2 + draw.normal(DIM).abs())
    scale_tril = shape * draw.size()[:, None, None]
    return Ellipsoid(draw(DIM), scale_tril.to(draw.dtype), validate_args=False)


def box(draw: Draw) -> Box:
    middle, half = draw(DIM), draw(DIM).abs()
    return Box(middle - half, torch.maximum(middle + half, middle - half))


def visible_region(draw: Draw) -> VisibleRegion:
    low, size = draw(1, DIM, decades=8), draw(1, DIM, decades=8).abs()
    step = draw(decades=8).abs()
    return VisibleRegion(
        draw(DIM, decades=8), torch.stack([low, low + size], -2), step, validate_args=False
    )


FAMILIES: dict[str, Callable[[Draw], ConstraintSet]] = {
    "box": box,
    "ball": lambda draw: Ball(draw(DIM), draw().abs(), validate_args=False),
    "ball about 0": lambda draw: Ball(0 * draw(DIM), draw().abs(), validate_args=False),
    "ellipsoid": ellipsoid,
    "half-spaces": lambda draw: HalfSpaces(draw(3, DIM), draw(3), validate_args=False),
    "task-space ball": lambda draw: TaskSpaceBall(
        draw(1, DIM), draw(1), draw().abs(), validate_args=False
    ),
    "weighted L1 ball": lambda draw: WeightedL1Ball(draw(DIM), draw().abs(), validate_args=False),
    "positive part": lambda draw: PositivePart(draw(DIM), draw().abs(), validate_args=False),
    "visible region": visible_region,
}


def valid(family: Callable[[Draw], ConstraintSet], draw: Draw) -> ConstraintSet:
    """Return drawn sets without those that are refused."""
    drawn, kept = family(draw), []
    for i in range(COUNT):
        one = drawn.select(torch.Size([COUNT]), torch.tensor([i]))
        with contextlib.suppress(GeometryError):
            one.validate()
            kept.append(i)
    return drawn.select(torch.Size([COUNT]), torch.tensor(kept))


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("dtype", DECADES, ids=str)
@pytest.mark.parametrize("family", FAMILIES)
def test_flows_keep_what_is_active(family: str, dtype: torch.dtype, unit: float) -> None:
    draw = Draw(dtype, seed=len(family))
    sets = valid(FAMILIES[family], draw)
    bounds = Box(-unit * torch.ones(DIM, dtype=dtype), unit * torch.ones(DIM, dtype=dtype))
    region = Region.build([bounds, sets])
    assert region.active is not None
    assert region.anchor.isfinite().all()
    latent = torch.randn(60, *region.shape, generator=draw.random, dtype=torch.float64).to(dtype)
    latent = torch.cat([size * latent for size in (0.5, 5, 1e6)])
    for flow in (ExactSquash(region), RadialSquash(region)):
        action, log_det = flow.forward_and_log_det(latent)
        assert action.isfinite().all()
        assert log_det.isfinite().all()
        assert region.contains(action).all()
        assert (sets.contains(action) | ~region.active[..., 1]).all()
    assert region.anchor.shape[0] > COUNT / 2
    if family == "ball about 0":
        assert region.active[:, 1].any()


BEYOND = {
    "radius": lambda huge: Ball(torch.zeros(2), huge),
    "center": lambda huge: Ball(huge.expand(2), torch.tensor(1.0)),
    "scale_tril": lambda huge: Ellipsoid(torch.zeros(2), huge * torch.eye(2)),
    "offsets": lambda huge: HalfSpaces(torch.ones(1, 2), huge.reshape(1)),
    "normals": lambda huge: HalfSpaces(huge.expand(1, 2), torch.ones(1)),
    "bound": lambda huge: PositivePart(torch.ones(2), huge),
    "jacobian": lambda huge: TaskSpaceBall(huge * torch.eye(2), torch.zeros(2), torch.tensor(1.0)),
}


@pytest.mark.parametrize("field", BEYOND)
def test_fields_beyond_the_range_are_refused(field: str) -> None:
    with pytest.raises(GeometryError, match=rf"'{field}'.*1e\+33.*given"):
        BEYOND[field](torch.tensor(1e36))


def test_a_degenerate_ellipsoid_is_refused() -> None:
    with pytest.raises(GeometryError, match="scale_tril"):
        Ellipsoid(torch.zeros(2), torch.tensor([[1e-10, 0.0], [1e10, 1e-10]]))
