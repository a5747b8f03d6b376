"""Compare `lexicographic_anchor` with SciPy on random intersections, and keep the result.

    python experiments/benchmarks/anchors.py [--cases 2000] [--seed 0]

Each case is an intersection of action bounds with 1 to 4 sets in 1 to 16 dimensions: roomy, tight,
or impossible, so that some must give way. Each amount is compared with the least one, given what
the library let the sets of higher priority give way by. SciPy's solvers (SLSQP, and cutting planes
by HiGHS for an upper bound) and NumPy's slacks share nothing with the library but the sets' fields.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

# Problems this small take several times as long on several threads; read when NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linprog, minimize
from torch import Tensor

from cnfp_torchrl.geometry import (
    LEEWAY,
    Ball,
    Box,
    ConstraintSet,
    Ellipsoid,
    HalfSpaces,
    PositivePart,
    TaskSpaceBall,
    WeightedL1Ball,
    attempt_anchor,
    chebyshev_center,
    lexicographic_anchor,
    row_depths,
)

Array = NDArray[np.float64]
Rows = Callable[[Array], tuple[Array, Array]]
"""From an action to the slacks of a set's rows ``(m,)`` and their gradients ``(m, d)``."""

FAMILIES = (Box, Ball, Ellipsoid, HalfSpaces, WeightedL1Ball, PositivePart, TaskSpaceBall)
# Shares of the dimensions; SciPy spends most of its time on the few large ones.
DIMS = {1: 0.15, 2: 0.25, 3: 0.25, 4: 0.15, 6: 0.12, 8: 0.06, 16: 0.02}
RESULT = Path(__file__).with_suffix(".json")


@dataclass
class Amount:
    """By how much one set gave way in one case, in action units.

    Args:
        family: The family of the set.
        dim: The dimension d of the actions.
        given: The set's largest row, less the leeway.
        least: Bounds of the least possible amount, given those of higher priority.
        depth: That the set keeps.
    """

    family: str
    dim: int
    given: float
    least: tuple[float, float]
    depth: float

    @property
    def error(self) -> float:
        """How far the amount is from the least one, in tolerances."""
        low, high = self.least
        off = max(low - self.given, self.given - high, 0.0)
        return off / (1e-3 * high + 0.1 * self.depth)

    @property
    def certain(self) -> bool:
        """Whether SciPy knows the least amount well enough to judge."""
        low, high = self.least
        return high - low <= 1e-3 * high + 0.1 * self.depth


@dataclass
class Comparison:
    """What came out of one case.

    Args:
        amounts: The amounts of all sets but the bounds.
        attempted: Whether a cheap attempt found an anchor.
        share: The anchor's share of the best slack in the sets, widened where they are relaxed.
    """

    amounts: list[Amount]
    attempted: bool
    share: float


def random_sets(rng: np.random.Generator, count: int) -> list[ConstraintSet]:
    """Return action bounds and 1 to 4 sets, as `count` random intersections of one structure."""
    dim = int(rng.choice(list(DIMS), p=list(DIMS.values())))
    bounds = Box(torch.full((count, dim), -1.0).double(), torch.full((count, dim), 1.0).double())
    anchor = rng.uniform(-0.8, 0.8, (count, dim))
    apart = rng.uniform(size=(count, 1)) < 0.4
    sets: list[ConstraintSet] = [bounds]
    for _ in range(rng.integers(1, 5)):
        # The slack of the anchor: roomy, tight, or (so that some intersections are empty) negative.
        tight = 10 ** rng.uniform(-5, -2, count)
        kind = rng.choice(3, count, p=[0.45, 0.4, 0.15])
        slack = np.choose(kind, [rng.uniform(0.05, 0.5, count), tight, -10 * tight])
        # Some of the intersections are of sets that have little to do with each other.
        elsewhere = rng.uniform(-1.5, 1.5, (count, dim))
        sets.append(_random_set(rng, np.where(apart, elsewhere, anchor), slack))
    if rng.uniform() < 0.5:
        return sets
    # Shrink until the best slack is about a wanted one, near the threshold more often than chance.
    wanted = rng.choice([-1, 1], count) * 10 ** rng.uniform(-4.5, -1.5, count)
    best = chebyshev_center(sets, share=0.99)
    shrink = best.slack - torch.from_numpy(wanted)
    return [bounds, *(_shrunk(constraint_set, shrink) for constraint_set in sets[1:])]


def _shrunk(constraint_set: ConstraintSet, by: Tensor) -> ConstraintSet:
    """Return the sets with their slack lowered everywhere, as far as they stay sets."""
    match constraint_set:
        case Box(low, high):
            by = torch.minimum(by.unsqueeze(-1), (high - low) / 2 - 1e-9)
            return Box(low + by, high - by)
        case Ball(center, radius):
            return Ball(center, (radius - by).clamp(min=1e-9))
        case Ellipsoid(center, scale_tril):
            norms = [_norm_bound(matrix) for matrix in scale_tril.inverse().numpy()]
            share = (1 - by * torch.tensor(norms, dtype=torch.float64)).clamp(min=1e-6)
            return Ellipsoid(center, scale_tril * share[:, None, None])
        case HalfSpaces(normals, offsets):
            return HalfSpaces(normals, offsets - by.unsqueeze(-1) * normals.norm(dim=-1))
        case TaskSpaceBall(jacobian, offset, radius):
            norm = torch.tensor([_norm_bound(matrix) for matrix in jacobian.numpy()]).double()
            return TaskSpaceBall(jacobian, offset, (radius - by * norm).clamp(min=1e-9))
        case WeightedL1Ball(weights, bound) | PositivePart(weights, bound):
            return type(constraint_set)(
                weights, (bound - by * weights.norm(dim=-1)).clamp(min=1e-9)
            )
    raise TypeError(type(constraint_set))


def _random_set(rng: np.random.Generator, anchor: Array, slack: Array) -> ConstraintSet:
    count, dim = anchor.shape
    family = FAMILIES[rng.integers(len(FAMILIES))]
    tensor = torch.from_numpy
    away = rng.normal(size=(count, dim))
    scale = 10 ** rng.uniform(-2, 1, (count, 1))
    if family is Box:
        sides = np.abs(slack)[:, None] + scale * rng.uniform(0, 1, (2, count, dim))
        sides[0, np.arange(count), rng.integers(dim, size=count)] = slack
        sides[1] = np.maximum(sides[1], 1e-6 - sides[0])
        return Box(tensor(anchor - sides[0]), tensor(anchor + sides[1]))
    if family is Ball:
        radius = np.linalg.norm(away * scale, axis=-1) + np.maximum(slack, 0)
        center = anchor + away * scale * ((radius - slack) / radius)[:, None]
        return Ball(tensor(center), tensor(np.linalg.norm(center - anchor, axis=-1) + slack))
    if family is Ellipsoid:
        tril = np.tril(rng.normal(size=(count, dim, dim)) * 0.3 / dim**0.5, -1)
        tril = tril + np.eye(dim) * rng.uniform(0.3, 1.5, (count, dim))[..., None]
        white = away / np.linalg.norm(away, axis=-1, keepdims=True) * rng.uniform(0, 1, (count, 1))
        offset = (tril @ white[..., None])[..., 0]
        size = np.maximum(scale[:, 0], 2 * np.abs(slack))
        grown = tril * size[:, None, None]
        return Ellipsoid(tensor(anchor + offset * (size + slack)[:, None]), tensor(grown))
    if family is HalfSpaces:
        normals = rng.normal(size=(count, int(rng.integers(1, 5)), dim)) * scale[..., None]
        lengths = np.linalg.norm(normals, axis=-1)
        offsets = (normals @ anchor[..., None])[..., 0] + slack[:, None] * lengths
        return HalfSpaces(tensor(normals), tensor(offsets))
    if family is TaskSpaceBall:
        jacobian = rng.normal(size=(count, int(rng.integers(1, dim + 1)), dim)) * scale[..., None]
        norms = np.array([_norm_bound(matrix) for matrix in jacobian])
        distance = norms * (np.maximum(-slack, 0) + 1e-3 + rng.uniform(0, 1, count))
        image = rng.normal(size=jacobian.shape[:2])
        image *= (distance / np.linalg.norm(image, axis=-1))[:, None]
        offset = image - (jacobian @ anchor[..., None])[..., 0]
        return TaskSpaceBall(tensor(jacobian), tensor(offset), tensor(distance + slack * norms))
    weights = away * scale * (rng.uniform(size=(count, dim)) > 0.2)
    weights[:, 0] += scale[:, 0]
    terms = weights * anchor
    terms = np.abs(terms) if family is WeightedL1Ball else np.maximum(terms, 0)
    bound = terms.sum(-1) + slack * np.linalg.norm(weights, axis=-1)
    bound = np.maximum(bound, 1e-3 * scale[:, 0])
    if family is WeightedL1Ball:
        return WeightedL1Ball(tensor(weights), tensor(bound))
    return PositivePart(tensor(weights), tensor(bound))


def rows_of(constraint_set: ConstraintSet, index: int) -> Rows:
    """Return the slacks of the rows of one set of a batch."""
    f = {name: value[index].double().numpy() for name, value in constraint_set.fields().items()}
    if isinstance(constraint_set, Box):
        identity = np.eye(len(f["low"]))
        gradient = np.concatenate([-identity, identity])
        return lambda a: (np.concatenate([f["high"] - a, a - f["low"]]), gradient)
    if isinstance(constraint_set, HalfSpaces):
        lengths = np.linalg.norm(f["normals"], axis=-1)
        normals = f["normals"] / lengths[:, None]
        return lambda a: (f["offsets"] / lengths - normals @ a, -normals)
    if isinstance(constraint_set, Ball):
        return _cone(np.eye(len(f["center"])), -f["center"], float(f["radius"]), 1.0)
    if isinstance(constraint_set, Ellipsoid):
        inverse = np.asarray(np.linalg.inv(f["scale_tril"]), dtype=np.float64)
        return _cone(inverse, -inverse @ f["center"], 1.0, _norm_bound(inverse))
    if isinstance(constraint_set, TaskSpaceBall):
        return _cone(f["jacobian"], f["offset"], float(f["radius"]), _norm_bound(f["jacobian"]))
    weights, bound = f["weights"], float(f["bound"])
    length = float(np.linalg.norm(weights))

    def sums(a: Array) -> tuple[Array, Array]:
        terms = weights * a
        signs = (
            np.sign(terms)
            if isinstance(constraint_set, WeightedL1Ball)
            else (terms > 0).astype(float)
        )
        slack = (bound - (signs * terms).sum()) / length
        return np.array([slack]), -(signs * weights / length)[None]

    return sums


def _cone(matrix: Array, vector: Array, size: float, rate: float) -> Rows:
    def rows(a: Array) -> tuple[Array, Array]:
        y = matrix @ a + vector
        length = float(np.linalg.norm(y))
        return np.array([(size - length) / rate]), -(matrix.T @ y)[None] / max(
            length, 1e-300
        ) / rate

    return rows


def _norm_bound(matrix: Array) -> float:
    bound = np.sqrt(np.abs(matrix).sum(0).max() * np.abs(matrix).sum(1).max())
    return float(min(bound, np.linalg.norm(matrix)))


def largest_excess(
    fixed: Sequence[tuple[Rows, Array]],
    maximized: Sequence[tuple[Rows, Array]],
    bounds: Sequence[tuple[float, float]],
    start: Array,
    precision: float,
) -> tuple[float, float]:
    """Return bounds of the largest t by which slacks of maximized sets exceed what is required.

    Args:
        fixed: Sets with the slacks that their rows must have.
        maximized: Sets with the slacks that their rows exceed by t.
        bounds: The bounds of the actions.
        start: An action to begin at.
        precision: How close the bounds shall come.
    """
    dim = len(start)

    def rooms(a: Array) -> tuple[Array, Array, Array]:
        """Return all rooms, their gradients in (action, t), and how often t counts."""
        every = [
            (rows(a), needs, on)
            for sets, on in ((fixed, 0.0), (maximized, 1.0))
            for rows, needs in sets
        ]
        room = np.concatenate([slack - needs for (slack, _), needs, _ in every])
        gradient = np.concatenate([g for (_, g), _, _ in every])
        counts = np.concatenate([np.full(len(needs), on) for _, needs, on in every])
        return room, np.column_stack([gradient, -counts]), counts

    def solve(a: Array) -> Array:
        room, _, counts = rooms(a)
        constraint = {
            "type": "ineq",
            "fun": lambda x: rooms(x[:dim])[0] - rooms(x[:dim])[2] * x[dim],
            "jac": lambda x: rooms(x[:dim])[1],
        }
        return minimize(
            lambda x: -x[dim],
            np.append(a, room[counts > 0].min()),
            jac=lambda x: -np.eye(dim + 1)[dim],
            method="SLSQP",
            constraints=[constraint],
            options={"maxiter": 100, "ftol": 1e-13},
        ).x[:dim]

    def value(a: Array) -> float:
        """Return the t of an action, with a fixed set's violation beyond a hair taken off."""
        room, _, counts = rooms(a)
        short = min(float(room[counts == 0].min()) + 1e-3 * precision, 0.0) if fixed else 0.0
        return float(room[counts > 0].min()) if short == 0 else -np.inf

    planes: list[Array] = []
    offsets: list[Array] = []

    def cut(a: Array) -> None:
        """Add the linearizations at an action, above which no concave slack lies."""
        room, gradient, _ = rooms(a)
        planes.append(-gradient)
        offsets.append(room - gradient[:, :dim] @ a)

    middle = np.array([(low + high) / 2 for low, high in bounds])
    lower, upper, inside = value(start), np.inf, start
    cut(middle)
    for _ in range(200):
        candidates = [solve(inside)] if upper == np.inf else []
        solved = linprog(
            -np.eye(dim + 1)[dim],
            np.concatenate(planes),
            np.concatenate(offsets),
            bounds=[*bounds, (None, None)],
        )
        if solved.success:
            upper = min(upper, float(solved.x[dim]))
            candidates += [solved.x[:dim], (solved.x[:dim] + inside) / 2]
        for point in candidates:
            if np.isfinite(point).all():
                cut(point)
                if value(point) > lower:
                    lower, inside = value(point), point
        if upper - lower <= precision or not solved.success:
            break
    return lower, upper


def compare(cases: int, seed: int, count: int = 10) -> list[Comparison]:
    """Compare on random cases, `count` of each structure at once."""
    rng = np.random.default_rng(seed)
    results: list[Comparison] = []
    while len(results) < cases:
        sets = random_sets(rng, count)
        found = lexicographic_anchor(sets)
        _, attempted = attempt_anchor(sets)
        depths = [depth.expand(count, depth.shape[-1]).numpy() for depth in row_depths(sets)]
        amounts = [amount.numpy() for amount in found.relaxation]
        for index in range(count):
            results.append(
                _compare_one(
                    [rows_of(constraint_set, index) for constraint_set in sets],
                    [type(constraint_set).__name__ for constraint_set in sets],
                    [depth[index] for depth in depths],
                    [amount[index] for amount in amounts],
                    found.anchor[index].numpy(),
                    bool(attempted[index]),
                )
            )
    return results


def _compare_one(
    rows: list[Rows],
    families: list[str],
    depths: list[Array],
    relaxation: list[Array],
    anchor: Array,
    attempted: bool,
) -> Comparison:
    leeway, bounds = 2 * LEEWAY, [(-1.0, 1.0)] * len(anchor)
    left = [depth - amount for depth, amount in zip(depths, relaxation, strict=True)]
    amounts = []
    for k in range(1, len(rows)):
        above = [0, *range(k + 1, len(rows))]
        fixed = [(rows[j], left[j]) for j in above]
        depth = float(depths[k].min())
        low, high = largest_excess(fixed, [(rows[k], depths[k])], bounds, anchor, 0.02 * depth)
        given = float(relaxation[k].max())
        least = (max(-high, 0.0), max(-low, 0.0))
        relaxed = given - leeway if given > 0 else 0.0
        amounts.append(Amount(families[k], len(anchor), relaxed, least, depth))
    widened = [(bounding, -amount) for bounding, amount in zip(rows, relaxation, strict=True)]
    _, best = largest_excess([], widened, bounds, anchor, 0.02 * float(depths[0].min()))
    slack = min(
        float((bounding(anchor)[0] + amount).min())
        for bounding, amount in zip(rows, relaxation, strict=True)
    )
    return Comparison(amounts, attempted, slack / best)


def main() -> None:
    """Run the comparison and write the result beside this file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=2_000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    started = time.perf_counter()
    results = compare(arguments.cases, arguments.seed)
    amounts = [amount for result in results for amount in result.amounts]
    relaxed = [amount for amount in amounts if amount.given > 0]
    summary = {
        "cases": len(results),
        "seed": arguments.seed,
        "amounts": len(amounts),
        "relaxed": len(relaxed),
        "relaxed by less than 1e-2": sum(amount.given < 1e-2 for amount in relaxed),
        "not known by SciPy": sum(not amount.certain for amount in amounts),
        "beyond the tolerance": sum(amount.error > 1 for amount in amounts if amount.certain),
        "largest error in tolerances": round(max(a.error for a in amounts if a.certain), 4),
        "decided by attempts": sum(result.attempted for result in results),
        "smallest share of the best slack": round(min(result.share for result in results), 4),
        "seconds": round(time.perf_counter() - started, 1),
    }
    text = json.dumps(summary, indent=2)
    RESULT.write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
