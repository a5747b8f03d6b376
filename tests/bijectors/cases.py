"""The table of bijectors over which the property tests run: every kind, every family of sets."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cache, partial

import torch
from mpmath import mpf
from torch import Tensor

from cnfp_torchrl.bijectors import (
    Bijector,
    BoxSquash,
    ExactSquash,
    GaugeSquash,
    RadialSquash,
    Recession,
    Retraction,
    SoftRetraction,
    SoftSquash,
    SquashChain,
    paper_squash,
)
from cnfp_torchrl.geometry import (
    Ball,
    Box,
    ConstraintSet,
    Ellipsoid,
    HalfSpaces,
    PositivePart,
    Region,
    TaskSpaceBall,
    VisibleRegion,
    WeightedL1Ball,
)
from tests.bijectors import reference

FLOWS = {
    "exact": reference.exact_squash,
    "gauge": reference.gauge_squash,
    "radial": reference.radial_squash,
    "retraction": reference.gauge_squash,
    "soft": partial(reference.soft_squash, sharpness=2, by_components=True),
    "soft-rays": partial(reference.soft_squash, sharpness=4, by_components=False),
    "soft-alone": partial(reference.soft_retraction, sharpness=2),
}
DTYPES = (torch.float32, torch.float64)


@dataclass(frozen=True)
class Case:
    """One bijector, and what it stands for.

    Args:
        name: The name for the test's id.
        kind: The kind: squash, chain (the paper's), exact, gauge, radial, retraction, soft,
            soft-rays, soft-alone or recession.
        sets: The sets in order of application, float64 of values that float32 holds too.
        anchor: The anchor of the kinds that have one, ``(*batch, d)``.
        active: Which sets hold, ``(*batch, len(sets))``; None means all.
        smooth: Whether the log-density has bounded gradients everywhere.
    """

    name: str
    kind: str
    sets: tuple[ConstraintSet, ...]
    anchor: Tensor | None = None
    active: Tensor | None = None
    smooth: bool = field(default=False, kw_only=True)

    @property
    def dim(self) -> int:
        return self.sets[0].dim

    @property
    def batch_shape(self) -> torch.Size:
        shapes = [constraint_set.batch_shape for constraint_set in self.sets]
        if self.anchor is not None:
            shapes.append(self.anchor.shape[:-1])
        if self.active is not None:
            shapes.append(self.active.shape[:-1])
        return torch.broadcast_shapes(*shapes)

    @property
    def size(self) -> float:
        """The size of the numbers that its actions consist of."""
        box = self.sets[0].bounding_box()
        return float(torch.maximum(box.low.abs(), box.high.abs()).max())

    @property
    def tightness(self) -> float:
        """How many times the anchor's slack fits into the sets' size: an error's amplification."""
        if self.anchor is None:
            return 1.0
        sizes = [
            float(constraint_set.fields()["radius"].max())
            for constraint_set in self.sets
            if isinstance(constraint_set, Ball)
        ]
        slack = self.region(torch.float64).slack(self.anchor).min()
        return max([self.size, *sizes]) / float(slack)

    @property
    def saturates(self) -> bool:
        """Whether the slope far from the anchor is below rounding error, by design."""
        return self.kind.startswith(("soft", "recession"))

    @property
    def cancellation(self) -> float:
        """The rounding error of a slope from autograd, which is a difference where it saturates."""
        # Of sharpness 2: the slope is the small difference of two terms, larger by divisor^2.
        return 4 * 2.0**-52 * self.tightness**2 if self.saturates else 0.0

    def cast(self, dtype: torch.dtype) -> tuple[ConstraintSet, ...]:
        return tuple(cast(constraint_set, dtype) for constraint_set in self.sets)

    def region(self, dtype: torch.dtype) -> Region:
        assert self.anchor is not None
        return Region(self.cast(dtype), self.anchor.to(dtype), self.active)

    def build(self, dtype: torch.dtype) -> Bijector:
        match self.kind:
            case "squash":
                return paper_squash(self.cast(dtype)[0])
            case "chain":
                return SquashChain(
                    [paper_squash(constraint_set) for constraint_set in self.cast(dtype)]
                )
            case "exact":
                return ExactSquash(self.region(dtype))
            case "gauge":
                return GaugeSquash(self.region(dtype))
            case "radial":
                return RadialSquash(self.region(dtype))
            case "recession":
                return Recession(self.region(dtype), of_latents=True)
            case "soft":
                return SoftSquash(self.region(dtype))
            case "soft-rays":
                return SoftSquash(self.region(dtype), sharpness=4, by_components=False)
            case "soft-alone":
                return SoftRetraction(self.region(dtype))
            case "retraction":
                outer, inner = self.cast(dtype)
                assert isinstance(outer, Box)
                assert self.anchor is not None
                retraction = Retraction(outer, inner, self.anchor.to(dtype))
                return SquashChain([BoxSquash(outer.low, outer.high), retraction])
        raise ValueError(self.kind)

    def allows(self, action: Tensor, number: type = float) -> Tensor:
        """Tell by independent arithmetic whether actions lie in every set that is guaranteed."""
        # The paper's chain guarantees its last set alone.
        first = len(self.sets) - 1 if self.kind == "chain" else 0
        inside = torch.ones(action.shape[:-1], dtype=torch.bool)
        for stage in range(first, len(self.sets)):
            inside &= self.allows_stage(stage, action, number)
        return inside

    def allows_stage(self, stage: int, action: Tensor, number: type = float) -> Tensor:
        mask = torch.as_tensor(reference.contains(self.sets[stage], action, number))
        return mask if self.active is None else mask | ~self.active[..., stage]

    def reference(self, index: tuple[int, ...]) -> Callable[[list[mpf]], tuple[list[mpf], mpf]]:
        """Return the flow of one batch element in mpmath."""
        sets = [element(constraint_set, self.batch_shape, index) for constraint_set in self.sets]
        if self.active is not None:
            active = self.active.expand((*self.batch_shape, len(sets)))[index]
            sets = [
                constraint_set for constraint_set, holds in zip(sets, active, strict=True) if holds
            ]
        if self.kind in ("squash", "chain"):
            return reference_chain(sets)
        assert self.anchor is not None
        anchor = self.anchor.expand((*self.batch_shape, self.dim))[index]
        flow = FLOWS[self.kind]
        return lambda latent: flow(sets, anchor, latent)


def reference_chain(
    sets: list[ConstraintSet],
) -> Callable[[list[mpf]], tuple[list[mpf], mpf]]:
    def flow(point: list[mpf]) -> tuple[list[mpf], mpf]:
        total = mpf(0)
        for constraint_set in sets:
            match constraint_set:
                case Box():
                    point, log_det = reference.box_squash(constraint_set, point)
                case Ball():
                    point, log_det = reference.ball_squash(constraint_set, point)
                case Ellipsoid():
                    point, log_det = reference.ellipsoid_squash(constraint_set, point)
                case _:
                    raise NotImplementedError(type(constraint_set).__name__)
            total += log_det
        return point, total

    return flow


def cast(constraint_set: ConstraintSet, dtype: torch.dtype) -> ConstraintSet:
    return type(constraint_set)(
        **{name: value.to(dtype) for name, value in constraint_set.fields().items()}
    )


def element(
    constraint_set: ConstraintSet, batch_shape: torch.Size, index: tuple[int, ...]
) -> ConstraintSet:
    """Return one set out of a batch."""
    values = {}
    for name, value in constraint_set.fields().items():
        event = value.shape[value.ndim - constraint_set.event_dims[name] :]
        values[name] = value.expand((*batch_shape, *event))[index]
    return type(constraint_set)(**values)


# Random sets around an anchor. All numbers are rounded to float32, so that both dtypes mean the
# same sets; the slack of the anchor is what remains after that.


class Maker:
    """Make random sets that hold a common anchor with a given slack.

    Args:
        dim: The dimension d.
        batch_shape: The batch shape of everything that is made.
        size: The half-width of the action bounds.
        slack: The anchor's least distance to each boundary, in units of `size`.
        offset: How far from 0 the bounds lie, in units of `size`.
    """

    def __init__(
        self,
        dim: int,
        batch_shape: tuple[int, ...] = (),
        *,
        size: float = 1.0,
        slack: float = 0.2,
        offset: float = 0.5,
        seed: int = 0,
    ) -> None:
        self.random = torch.Generator().manual_seed(seed)
        self.dim, self.batch_shape, self.size = dim, batch_shape, size
        middle = offset * size * self.normal(dim)
        half = size * (0.5 + self.uniform(dim))
        self.low, self.high = rounded(middle - half), rounded(middle + half)
        # Rounding errors of float32 in all that follows, twice, as the package's own anchors have.
        magnitude = float(torch.maximum(self.low.abs(), self.high.abs()).max())
        self.rounding = 64 * 2.0**-23 * magnitude * math.sqrt(dim)
        self.slack = slack * size + self.rounding
        margin = self.slack + (2 * half - 2 * self.slack) * self.uniform(dim) ** 3
        self.anchor = rounded(
            torch.where(self.uniform(dim) < 0.5, middle - half + margin, middle + half - margin)
        )

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(*self.batch_shape, *shape, generator=self.random, dtype=torch.float64)

    def uniform(self, *shape: int) -> Tensor:
        return torch.rand(*self.batch_shape, *shape, generator=self.random, dtype=torch.float64)

    def direction(self) -> Tensor:
        vector = self.normal(self.dim)
        return vector / vector.norm(dim=-1, keepdim=True)

    def gap(self) -> Tensor:
        """Return distances from the anchor to a boundary: the slack to 30 times as much."""
        return self.slack * 30 ** self.uniform(1)

    def bounds(self) -> Box:
        return Box(self.low, self.high)

    def box(self) -> Box:
        below, above = (self.slack * 30 ** self.uniform(self.dim) for _ in range(2))
        return Box(rounded(self.anchor - below), rounded(self.anchor + above))

    def open_box(self) -> Box:
        box = self.box()
        return Box(box.low, torch.full_like(box.high, torch.inf))

    def ball(self, radius: float = 0.8) -> Ball:
        r = radius * self.size * (0.5 + self.uniform(1))
        gap = torch.minimum(self.gap() + 2 * self.rounding * radius, r)
        center = self.anchor - (r - gap) * self.direction()
        return Ball(rounded(center), rounded(r.squeeze(-1)))

    def large_ball(self) -> Ball:
        return self.ball(6.0)

    def ellipsoid(self, aspect: float = 4.0) -> Ellipsoid:
        tril = 0.3 * self.normal(self.dim, self.dim).tril(-1) / math.sqrt(self.dim)
        diagonal = aspect ** (self.uniform(self.dim) - 0.5)
        tril = rounded(0.8 * self.size * (tril + torch.diag_embed(diagonal)))
        # In the unit ball's coordinates a distance is longer by at most the inverse's norm.
        inverse = torch.linalg.inv(tril).norm(dim=(-2, -1)).unsqueeze(-1)
        depth = 1 - torch.clamp((self.gap() + 8 * self.rounding) * inverse, max=1.0)
        white = self.direction() * depth
        return Ellipsoid(rounded(self.anchor - (tril @ white.unsqueeze(-1)).squeeze(-1)), tril)

    def half_spaces(self, rows: int = 3) -> HalfSpaces:
        normals = rounded(self.normal(rows, self.dim))
        gap = (self.slack * 30 ** self.uniform(rows)) * normals.norm(dim=-1)
        return HalfSpaces(normals, rounded((normals * self.anchor.unsqueeze(-2)).sum(-1) + gap))

    def weighted_l1(self) -> WeightedL1Ball:
        weights = rounded(self.normal(self.dim))
        used = (weights * self.anchor).abs().sum(-1)
        return WeightedL1Ball(weights, rounded(used + self._room(weights)))

    def positive_part(self) -> PositivePart:
        weights = rounded(self.normal(self.dim))
        used = (weights * self.anchor).clamp(min=0).sum(-1)
        return PositivePart(weights, rounded(used + self._room(weights)))

    def task_space_ball(self) -> TaskSpaceBall:
        """As many rows as half of the components, so that there is a null space if d > 1."""
        jacobian = rounded(self.normal((self.dim + 1) // 2, self.dim))
        norm = jacobian.norm(dim=(-2, -1))
        gap = (self.gap().squeeze(-1) + 8 * self.rounding * math.sqrt(self.dim)) * norm
        radius = gap + norm * self.size * self.uniform(1).squeeze(-1)
        towards = self.normal(jacobian.shape[-2])
        towards = towards / towards.norm(dim=-1, keepdim=True) * (radius - gap).unsqueeze(-1)
        image = (jacobian * self.anchor.unsqueeze(-2)).sum(-1)
        return TaskSpaceBall(jacobian, rounded(towards - image), rounded(radius))

    def _room(self, weights: Tensor) -> Tensor:
        gap = self.slack * 30 ** self.uniform(1).squeeze(-1)
        return (gap + 4 * self.rounding * math.sqrt(self.dim)) * weights.norm(dim=-1)


def rounded(value: Tensor) -> Tensor:
    return value.float().double()


def tensor(*values: float) -> Tensor:
    return rounded(torch.tensor(values, dtype=torch.float64))


@cache
def squashes() -> tuple[Case, ...]:
    """The paper's squashes, one set each."""
    small, large = Maker(6, size=1e-3, seed=1), Maker(32, size=1e3, seed=2)
    several, line = Maker(3, (4,), seed=3), Maker(1, (2, 3), seed=4)
    plane = Maker(2, seed=5)
    far = Maker(2, offset=100.0, seed=6)
    return (
        Case("box-d1-batch", "squash", (line.bounds(),), smooth=True),
        Case("box-d2", "squash", (plane.bounds(),), smooth=True),
        Case("box-d2-far", "squash", (far.bounds(),), smooth=True),
        Case("box-d3-batch", "squash", (several.bounds(),), smooth=True),
        Case("box-d6-small", "squash", (small.bounds(),), smooth=True),
        Case("box-d32-large", "squash", (large.bounds(),), smooth=True),
        Case("ball-d1-batch", "squash", (line.ball(),), smooth=True),
        Case("ball-d2", "squash", (plane.ball(),), smooth=True),
        Case("ball-d2-far", "squash", (far.ball(),), smooth=True),
        Case("ball-d3-batch", "squash", (several.ball(),), smooth=True),
        Case("ball-d6-small", "squash", (small.ball(),), smooth=True),
        Case("ball-d32-large", "squash", (large.ball(),), smooth=True),
        Case("ellipsoid-d1-batch", "squash", (line.ellipsoid(),), smooth=True),
        Case("ellipsoid-d2-slim", "squash", (plane.ellipsoid(aspect=100.0),), smooth=True),
        Case("ellipsoid-d3-batch", "squash", (several.ellipsoid(),), smooth=True),
        Case("ellipsoid-d6-small", "squash", (small.ellipsoid(),), smooth=True),
        Case("ellipsoid-d32-large", "squash", (large.ellipsoid(),), smooth=True),
    )


@cache
def chains() -> tuple[Case, ...]:
    """The paper's policy: squashes applied one after the other."""
    plane, several, many = Maker(2, seed=10), Maker(3, (4,), seed=11), Maker(6, seed=12)
    return (
        Case("ball-box-d2", "chain", (plane.ball(), plane.bounds())),
        Case("box-ball-d2", "chain", (plane.bounds(), plane.ball())),
        Case(
            "box-ellipsoid-ball-d3-batch",
            "chain",
            (several.bounds(), several.ellipsoid(), several.ball()),
        ),
        Case("box-ball-d3-mixed-batch", "chain", (Maker(3, seed=13).bounds(), several.ball())),
        Case("ball-ball-d6", "chain", (many.ball(), many.ball())),
    )


Regions = dict[str, tuple[tuple[ConstraintSet, ...], Tensor, Tensor | None]]


@cache
def regions() -> Regions:
    """Regions: sets, anchor and active flags by name."""
    found: Regions = {}

    def add(name: str, make: Maker, *families: Callable[[Maker], ConstraintSet]) -> None:
        sets = (make.bounds(), *(family(make) for family in families))
        found[name] = (sets, make.anchor, None)

    add("bounds-d1", Maker(1, seed=20))
    add("ball-d1", Maker(1, seed=21), Maker.ball)
    add("half-spaces-ball-d1-batch", Maker(1, (2, 3), seed=22), Maker.half_spaces, Maker.ball)
    add("bounds-d2", Maker(2, seed=23))
    add("ball-d2", Maker(2, seed=24), Maker.ball)
    add("box-ball-d2", Maker(2, seed=25), Maker.box, Maker.ball)
    add("open-box-d2", Maker(2, seed=26), Maker.open_box)
    add("boxes-d6-batch", Maker(6, (3,), seed=43), Maker.box, Maker.open_box)
    add("ellipsoid-d2-batch", Maker(2, (4,), seed=27), Maker.ellipsoid)
    add("half-spaces-l1-d2", Maker(2, seed=28), Maker.half_spaces, Maker.weighted_l1)
    add("far-d2", Maker(2, offset=100.0, seed=29), Maker.ball, Maker.half_spaces)
    add(
        "tight-d2-batch",
        Maker(2, (4,), slack=1e-4, seed=30),
        Maker.box,
        Maker.large_ball,
        Maker.half_spaces,
    )
    add(
        "all-families-d3-batch",
        Maker(3, (2, 2), slack=0.05, seed=31),
        Maker.box,
        Maker.ball,
        Maker.ellipsoid,
        Maker.half_spaces,
        Maker.weighted_l1,
        Maker.positive_part,
    )
    add(
        "small-d6", Maker(6, size=1e-3, slack=0.05, seed=32), Maker.box, Maker.ball, Maker.ellipsoid
    )
    add("task-space-d2-batch", Maker(2, (3,), seed=44), Maker.task_space_ball)
    add("task-space-box-d6", Maker(6, seed=45), Maker.box, Maker.task_space_ball)
    add("l1-d6-batch", Maker(6, (3,), slack=0.05, seed=33), Maker.weighted_l1)
    add(
        "large-d32",
        Maker(32, size=1e3, slack=0.02, seed=34),
        Maker.large_ball,
        Maker.ellipsoid,
        Maker.positive_part,
    )
    # A set a thousand times smaller than the bounds around it.
    tiny = Maker(3, size=1e-3, seed=35)
    bounds = Box(rounded(tiny.anchor - 1), rounded(tiny.anchor + 1))
    found["tiny-in-large-d3"] = ((bounds, tiny.bounds(), tiny.ball()), tiny.anchor, None)
    found["huge-ball-d2"] = _huge_ball()
    found["visible-d2-batch"] = _visible()
    found["dropped-d3-batch"] = _dropped()
    found["mixed-batches-d3"] = _mixed()
    return found


def _huge_ball() -> tuple[tuple[ConstraintSet, ...], Tensor, None]:
    """A battery far from its station: the ball's center is 72 away, its boundary in the bounds."""
    ball = Ball(tensor(-50.9116, -50.9117), tensor(72.5).squeeze())
    return (Box(tensor(-1.0, -1.0), tensor(1.0, 1.0)), ball), tensor(0.25, -0.125), None


def _visible() -> tuple[tuple[ConstraintSet, ...], Tensor, None]:
    """Three places beside a rectangle in an arena, and a ball; the anchor is not always 0."""
    rectangle = torch.stack([tensor(-0.3, -0.3), tensor(0.3, 0.3)]).unsqueeze(0)
    walls = VisibleRegion.walls(tensor(-1.0, -1.0), tensor(1.0, 1.0))
    position = torch.stack([tensor(-0.35, 0.32), tensor(0.6, -0.31), tensor(0.95, 0.95)])
    seen = VisibleRegion(position, torch.cat([rectangle, walls]), tensor(0.1).squeeze())
    anchor = torch.stack([tensor(-0.25, 0.0), tensor(0.125, -0.25), tensor(-0.125, -0.125)])
    bounds = Box(tensor(-1.0, -1.0), tensor(1.0, 1.0))
    return (bounds, seen, Ball(tensor(-0.25, 0.0), tensor(0.8).squeeze())), anchor, None


def _dropped() -> tuple[tuple[ConstraintSet, ...], Tensor, Tensor]:
    """Four states of three constraints; where one is dropped, the anchor does not lie in it."""
    make = Maker(3, (4,), seed=36)
    active = torch.tensor(
        [
            [True, True, True, True],
            [True, False, True, True],
            [True, True, True, False],
            [True, False, False, False],
        ]
    )
    ball = make.ball()
    away = Ball(torch.where(active[:, 1:2], ball.center, ball.center + 100.0), ball.radius)
    return (make.bounds(), away, make.ellipsoid(), make.positive_part()), make.anchor, active


def _mixed() -> tuple[tuple[ConstraintSet, ...], Tensor, Tensor]:
    """One anchor, and sets and flags whose batch shapes have to be broadcast."""
    one, rows, columns = Maker(3, seed=37), Maker(3, (4, 1), seed=38), Maker(3, (2,), seed=39)
    rows.anchor = columns.anchor = one.anchor
    active = torch.tensor([[True, True, True], [True, False, True]])
    return (one.bounds(), rows.ball(), columns.half_spaces()), one.anchor, active


@cache
def exact_flows() -> tuple[Case, ...]:
    """Gauge and radial squashes over all regions, and retractions."""
    found = []
    for name, (sets, anchor, active) in regions().items():
        smooth = len(sets) == 1
        found.append(Case(f"gauge-{name}", "gauge", sets, anchor, active, smooth=smooth))
        boxes = all(isinstance(constraint_set, Box) for constraint_set in sets)
        found.append(Case(f"exact-{name}", "exact", sets, anchor, active, smooth=boxes))
        found.append(Case(f"radial-{name}", "radial", sets, anchor, active))
        found.append(Case(f"soft-{name}", "soft", sets, anchor, active))
    for name in (
        *("ball-d1", "box-ball-d2", "half-spaces-l1-d2", "all-families-d3-batch"),
        "dropped-d3-batch",
    ):
        found.append(Case(f"soft-rays-{name}", "soft-rays", *regions()[name]))
    for name in (
        *("half-spaces-ball-d1-batch", "half-spaces-l1-d2", "far-d2", "all-families-d3-batch"),
        *("tight-d2-batch", "mixed-batches-d3"),
    ):
        found.append(Case(f"recession-{name}", "recession", *regions()[name]))
    for name in (
        *("bounds-d1", "bounds-d2", "box-ball-d2", "open-box-d2", "half-spaces-l1-d2"),
        *("dropped-d3-batch", "large-d32"),
    ):
        found.append(Case(f"soft-alone-{name}", "soft-alone", *regions()[name]))
    plane, many = Maker(2, seed=40), Maker(6, (3,), slack=0.05, seed=41)
    tight = Maker(3, (5,), slack=1e-4, seed=42)
    found += [
        Case("retraction-ball-d2", "retraction", (plane.bounds(), plane.ball()), plane.anchor),
        Case(
            "retraction-ellipsoid-d6-batch",
            "retraction",
            (many.bounds(), many.ellipsoid()),
            many.anchor,
        ),
        Case(
            "retraction-tight-d3-batch",
            "retraction",
            (tight.bounds(), tight.large_ball()),
            tight.anchor,
        ),
    ]
    return tuple(found)


CASES = (*squashes(), *chains(), *exact_flows())
BY_NAME = {case.name: case for case in CASES}
PLANE = tuple(case for case in CASES if case.dim == 2)


def latents(case: Case, count: int, dtype: torch.dtype, length: float | None = None) -> Tensor:
    """Return base samples ``(count, *batch, d)``, of a given length or standard normal.

    Of those of a given length, some lie on the axes and some on the diagonals, where a tanh
    saturates in one or in all components.
    """
    z = torch.randn(count, *case.batch_shape, case.dim, dtype=torch.float64)
    if length is None:
        return z.to(dtype)
    kind = torch.rand(*z.shape[:-1], 1)
    axis = torch.where(z.abs() == z.abs().amax(-1, keepdim=True), z, 0.0)
    z = torch.where(kind < 0.6, z, torch.where(kind < 0.8, z.sign(), axis))
    return (z / z.norm(dim=-1, keepdim=True) * length).to(dtype)


def latents_of(case: Case, count: int, dtype: torch.dtype, lengths: Iterable[float]) -> Tensor:
    """Return base samples of several lengths, ``(lengths * count, *batch, d)``."""
    return torch.cat([latents(case, count, dtype, length) for length in lengths])
