"""Compare `lexicographic_anchor` with SciPy on random intersections, and keep the result.

    python experiments/benchmarks/anchors.py [--cases 10000] [--seed 0]

Each case is an intersection of action bounds with 1 to 6 sets in 1 to 32 dimensions, some of them
tight, some empty. SciPy's solver (HiGHS for polyhedra, SLSQP otherwise) and a NumPy evaluation of
the slack share nothing with the library but the sets' fields.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
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
    MINIMUM_SLACK,
    Ball,
    Box,
    ConstraintSet,
    Ellipsoid,
    HalfSpaces,
    PositivePart,
    TaskSpaceBall,
    WeightedL1Ball,
    chebyshev_center,
    lexicographic_anchor,
)

Array = NDArray[np.float64]
FAMILIES = (Box, Ball, Ellipsoid, HalfSpaces, WeightedL1Ball, PositivePart, TaskSpaceBall)
# Shares of the dimensions; SciPy spends most of its time on the few large ones.
DIMS = {1: 0.1, 2: 0.15, 3: 0.15, 4: 0.14, 6: 0.14, 8: 0.12, 12: 0.08, 16: 0.06, 24: 0.03, 32: 0.03}
RESULT = Path(__file__).with_suffix(".json")


@dataclass
class Comparison:
    """What came out of one case; slacks in action units, evaluated by NumPy."""

    dim: int
    families: list[str]
    feasible: bool
    slack: float
    scipy_slack: float

    @property
    def best(self) -> float:
        """The best slack that is known."""
        return max(self.slack, self.scipy_slack) if self.feasible else self.scipy_slack

    @property
    def decided_rightly(self) -> bool:
        """Whether emptiness is agreed on, except within 1e-4 of the threshold."""
        if self.feasible:
            return self.slack >= MINIMUM_SLACK - 1e-4
        return self.scipy_slack <= MINIMUM_SLACK + 1e-4

    @property
    def deep_enough(self) -> bool:
        """Whether an anchor has a third of the best slack."""
        return not self.feasible or self.best <= 0 or self.slack >= self.best / 3


def random_sets(rng: np.random.Generator, count: int) -> list[ConstraintSet]:
    """Return action bounds and 1 to 6 sets, as `count` random intersections of one structure."""
    dim = int(rng.choice(list(DIMS), p=list(DIMS.values())))
    bounds = Box(torch.full((count, dim), -1.0).double(), torch.full((count, dim), 1.0).double())
    anchor = rng.uniform(-0.8, 0.8, (count, dim))
    sets: list[ConstraintSet] = [bounds]
    for _ in range(rng.integers(1, 7)):
        # The slack of the anchor: roomy, tight, or (so that some intersections are empty) negative.
        tight = 10 ** rng.uniform(-5, -2, count)
        kind = rng.choice(3, count, p=[0.45, 0.4, 0.15])
        slack = np.choose(kind, [rng.uniform(0.05, 0.5, count), tight, -10 * tight])
        sets.append(_random_set(rng, anchor, slack))
    if rng.uniform() < 0.5:
        return sets
    # Shrink until the best slack is about a wanted one, near the threshold more often than chance.
    wanted = rng.choice([-1, 1], count) * 10 ** rng.uniform(-4.5, -1.5, count)
    best = chebyshev_center(sets, enough=-torch.inf, share=0.99)
    shrink = best.slack - torch.from_numpy(wanted)
    return [bounds, *(_shrunk(each, shrink) for each in sets[1:])]


def _shrunk(each: ConstraintSet, by: Tensor) -> ConstraintSet:
    """Return the sets with their slack lowered everywhere, as far as they stay sets."""
    match each:
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
            return type(each)(weights, (bound - by * weights.norm(dim=-1)).clamp(min=1e-9))
    raise TypeError(type(each))


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


def scipy_best_slack(sets: list[ConstraintSet], index: int) -> float:
    """Return the best slack that SciPy finds for one of the intersections.

    The variables are action and slack. Kinked sums enter by their facets, added where violated.
    """
    dim = sets[0].dim
    parts = [{n: v[index].numpy() for n, v in each.fields().items()} for each in sets]
    rows, offsets = _linear_rows(sets, parts)
    kinked = [(each, p) for each, p in zip(sets, parts, strict=True) if "weights" in p]
    cones = [_cone_functions(p, dim) for p in parts if "center" in p or "jacobian" in p]
    x = np.zeros(dim + 1)
    best = -np.inf
    for _ in range(100):
        if not cones:
            solved = linprog(-np.eye(dim + 1)[dim], rows, offsets, bounds=(None, None))
            assert solved.success, solved.message
            x = solved.x
        else:
            x[dim] = min(numpy_slack(sets, index, x[:dim]), x[dim])
            x = _slsqp(rows, offsets, cones, x)
        slack = numpy_slack(sets, index, x[:dim])
        best = max(best, slack)
        if not kinked or x[dim] - slack < 1e-8:
            break
        facets = [_facet(each, part, x[:dim]) for each, part in kinked]
        rows = np.concatenate([rows, [row for row, _ in facets]])
        offsets = np.concatenate([offsets, [offset for _, offset in facets]])
    return best


def _slsqp(rows: Array, offsets: Array, cones: list[Cone], start: Array) -> Array:
    cost = -np.eye(len(start))[-1]
    linear = {"type": "ineq", "fun": lambda x: offsets - rows @ x, "jac": lambda x: -rows}
    return minimize(
        lambda x: -x[-1],
        start,
        jac=lambda x: cost,
        method="SLSQP",
        constraints=[linear, *({"type": "ineq", "fun": fun, "jac": jac} for fun, jac in cones)],
        options={"maxiter": 100, "ftol": 1e-10},
    ).x


def _linear_rows(sets: list[ConstraintSet], parts: list[dict[str, Array]]) -> tuple[Array, Array]:
    """Return rows in (action, slack), of length one in the action, and their offsets."""
    unit, one = np.eye(sets[0].dim), np.ones((sets[0].dim, 1))
    rows, offsets = [], []
    for each, part in zip(sets, parts, strict=True):
        if isinstance(each, Box):
            rows += [np.hstack([unit, one]), np.hstack([-unit, one])]
            offsets += [part["high"], -part["low"]]
        elif isinstance(each, HalfSpaces):
            lengths = np.linalg.norm(part["normals"], axis=-1, keepdims=True)
            rows.append(np.hstack([part["normals"] / lengths, np.ones_like(lengths)]))
            offsets.append(part["offsets"] / lengths[:, 0])
    return np.concatenate(rows), np.concatenate(offsets)


def _facet(each: ConstraintSet, part: dict[str, Array], action: Array) -> tuple[Array, float]:
    weights = part["weights"]
    terms = weights * action
    signs = np.sign(terms) if isinstance(each, WeightedL1Ball) else (terms > 0).astype(float)
    norm = np.linalg.norm(weights)
    return np.append(signs * weights / norm, 1), float(part["bound"] / norm)


Cone = tuple[Callable[[Array], Array], Callable[[Array], Array]]


def _cone_functions(part: dict[str, Array], dim: int) -> Cone:
    """Return by how much ``(height - |W a + y|) / rate`` exceeds the slack, and its gradient."""
    white: Array = np.eye(dim)
    rate, height = 1.0, float(part.get("radius", 1.0))
    if "jacobian" in part:
        white, rate = part["jacobian"], _norm_bound(part["jacobian"])
    if "scale_tril" in part:
        white = np.asarray(np.linalg.inv(part["scale_tril"]), dtype=np.float64)
        rate = _norm_bound(white)
    vector = part["offset"] if "offset" in part else -white @ part["center"]

    def fun(x: Array) -> Array:
        length = np.linalg.norm(white @ x[:dim] + vector)
        return np.array([(height - length) / rate - x[dim]])

    def jac(x: Array) -> Array:
        y = white @ x[:dim] + vector
        length = max(float(np.linalg.norm(y)), 1e-12)
        return np.append(-(white.T @ y) / length / rate, -1.0)[None]

    return fun, jac


def _norm_bound(matrix: Array) -> float:
    bound = np.sqrt(np.abs(matrix).sum(0).max() * np.abs(matrix).sum(1).max())
    return float(min(bound, np.linalg.norm(matrix)))


def numpy_slack(sets: list[ConstraintSet], index: int, action: Array) -> float:
    """Return the smallest slack of an action in one of the intersections, by NumPy alone."""
    slacks: list[float] = []
    for each in sets:
        f = {name: value[index].numpy() for name, value in each.fields().items()}
        if isinstance(each, Box):
            slacks.append(min((f["high"] - action).min(), (action - f["low"]).min()))
        elif isinstance(each, Ball):
            slacks.append(float(f["radius"] - np.linalg.norm(action - f["center"])))
        elif isinstance(each, Ellipsoid):
            inverse = np.linalg.inv(f["scale_tril"])
            length = np.linalg.norm(inverse @ (action - f["center"]))
            slacks.append(float((1 - length) / _norm_bound(inverse)))
        elif isinstance(each, TaskSpaceBall):
            length = np.linalg.norm(f["jacobian"] @ action + f["offset"])
            slacks.append(float((f["radius"] - length) / _norm_bound(f["jacobian"])))
        elif isinstance(each, HalfSpaces):
            room = f["offsets"] - f["normals"] @ action
            slacks.append((room / np.linalg.norm(f["normals"], axis=-1)).min())
        else:
            terms = f["weights"] * action
            terms = np.abs(terms) if isinstance(each, WeightedL1Ball) else np.maximum(terms, 0)
            slacks.append((f["bound"] - terms.sum()) / np.linalg.norm(f["weights"]))
    return float(min(slacks))


def compare(cases: int, seed: int, count: int = 10) -> list[Comparison]:
    """Compare on random cases, `count` of each structure at once."""
    rng = np.random.default_rng(seed)
    results: list[Comparison] = []
    while len(results) < cases:
        sets = random_sets(rng, count)
        anchors, active = lexicographic_anchor(sets)
        for index in range(count):
            results.append(_compare_one(sets, index, anchors[index], active[index]))
    return results


def _compare_one(
    sets: list[ConstraintSet], index: int, anchor: Tensor, active: Tensor
) -> Comparison:
    feasible = bool(active.all())
    return Comparison(
        dim=sets[0].dim,
        families=[type(each).__name__ for each in sets[1:]],
        feasible=feasible,
        slack=numpy_slack(sets, index, anchor.numpy()) if feasible else float("nan"),
        scipy_slack=scipy_best_slack(sets, index),
    )


def main() -> None:
    """Run the comparison and write the result beside this file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    started = time.perf_counter()
    results = compare(arguments.cases, arguments.seed)
    feasible = [r for r in results if r.feasible]
    near = [r for r in results if abs(r.best - MINIMUM_SLACK) <= 1e-4]
    shares = [r.slack / r.best for r in feasible if r.best > MINIMUM_SLACK]
    summary = {
        "cases": len(results),
        "seed": arguments.seed,
        "minimum_slack": MINIMUM_SLACK,
        "feasible": len(feasible),
        "tight (best slack below 1e-2)": sum(r.best < 1e-2 for r in feasible),
        "empty": len(results) - len(feasible),
        "within 1e-4 of the threshold": len(near),
        "wrongly decided": sum(not r.decided_rightly for r in results),
        "anchors with less than a third of the best slack": sum(not r.deep_enough for r in results),
        "smallest share of the best slack": round(min(shares), 4),
        "SciPy found less slack than the library": sum(r.scipy_slack < r.slack for r in feasible),
        "seconds": round(time.perf_counter() - started, 1),
    }
    text = json.dumps(summary, indent=2)
    RESULT.write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
