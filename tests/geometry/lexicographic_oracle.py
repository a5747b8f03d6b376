"""The lexicographic rule of one state by SciPy, from the sets' fields and NumPy alone.

Shares nothing with the library: rows of slack and their gradients are written out here, and the
least amounts come from SLSQP, and from trust-region steps by linear programs where it fails.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog, minimize

from cnfp_torchrl.geometry import (
    Ball,
    Box,
    ConstraintSet,
    Ellipsoid,
    HalfSpaces,
    TaskSpaceBall,
    WeightedL1Ball,
)

Array = NDArray[np.float64]
Rows = Callable[[Array], tuple[Array, Array]]
"""From an action to the slacks of a set's rows ``(m,)`` and their gradients ``(m, d)``."""


def norm_bound(matrix: Array) -> float:
    """Return the bound of the spectral norm by which the families measure slack."""
    bound = np.sqrt(np.abs(matrix).sum(0).max() * np.abs(matrix).sum(1).max())
    return float(min(bound, np.linalg.norm(matrix)))


def rows_of(each: ConstraintSet, index: int) -> Rows:
    """Return the slacks of the rows of one set of a batch."""
    shape = each.batch_shape
    f = {
        n: v.double().expand(*shape, *v.shape[v.ndim - each.event_dims[n] :]).numpy()[index]
        for n, v in each.fields().items()
    }
    if isinstance(each, Box):
        identity = np.eye(len(f["low"]))
        gradient = np.concatenate([-identity, identity])
        return lambda a: (np.concatenate([f["high"] - a, a - f["low"]]), gradient)
    if isinstance(each, HalfSpaces):
        lengths = np.linalg.norm(f["normals"], axis=-1)
        normals = f["normals"] / lengths[:, None]
        return lambda a: (f["offsets"] / lengths - normals @ a, -normals)
    if isinstance(each, Ball):
        return _cone(np.eye(len(f["center"])), -f["center"], float(f["radius"]), 1.0)
    if isinstance(each, Ellipsoid):
        inverse = np.asarray(np.linalg.inv(f["scale_tril"]), dtype=np.float64)
        return _cone(inverse, -inverse @ f["center"], 1.0, norm_bound(inverse))
    if isinstance(each, TaskSpaceBall):
        return _cone(f["jacobian"], f["offset"], float(f["radius"]), norm_bound(f["jacobian"]))
    weights, bound = f["weights"], float(f["bound"])
    length = float(np.linalg.norm(weights))

    def sums(a: Array) -> tuple[Array, Array]:
        terms = weights * a
        signs = np.sign(terms) if isinstance(each, WeightedL1Ball) else (terms > 0).astype(float)
        return np.array([(bound - (signs * terms).sum()) / length]), -(signs * weights / length)[
            None
        ]

    return sums


def _cone(matrix: Array, vector: Array, size: float, rate: float) -> Rows:
    def rows(a: Array) -> tuple[Array, Array]:
        y = matrix @ a + vector
        length = float(np.linalg.norm(y))
        gradient = -(matrix.T @ y) / max(length, 1e-300) / rate
        return np.array([(size - length) / rate]), gradient[None]

    return rows


@dataclass
class State:
    """The sets of one state, with what each of their rows keeps as depth.

    Args:
        rows: one for each set, the action bounds first.
        depth: of each set's rows, ``(m,)`` a set.
        low: the action bounds.
        high: the same.
    """

    rows: list[Rows]
    depth: list[Array]
    low: Array
    high: Array

    def excess(self, k: int, relaxed: list[Array], start: Array) -> float:
        """Return the largest t by which the slack of set k can exceed its depth.

        Subject to what the bounds and all sets of higher priority have left.

        Args:
            k: the set.
            relaxed: by how much the rows of each set are relaxed; those of k and lower ones do not
                matter.
            start: a point to begin at.
        """
        fixed = [0, *range(k + 1, len(self.rows))]
        scale = float((self.high - self.low).min())

        def rooms(a: Array) -> tuple[Array, Array, Array, Array]:
            must = [self.rows[j](a) for j in fixed]
            slack = np.concatenate(
                [s - self.depth[j] + relaxed[j] for (s, _), j in zip(must, fixed, strict=True)]
            )
            own, own_gradient = self.rows[k](a)
            return slack, np.concatenate([g for _, g in must]), own - self.depth[k], own_gradient

        # Cutting planes: every linearization of a concave slack lies above it.
        dim = len(self.low)
        matrix: list[Array] = []
        offset: list[float] = []

        def cut(a: Array) -> None:
            slack, gradient, own, own_gradient = rooms(a)
            for s, g, on in [
                *((s, g, 0.0) for s, g in zip(slack, gradient, strict=True)),
                *((s, g, 1.0) for s, g in zip(own, own_gradient, strict=True)),
            ]:
                # t on <= s + g (x - a)
                matrix.append(np.append(-g, on))
                offset.append(float(s - g @ a))

        best, inside = -np.inf, start
        for begin in (start, (self.low + self.high) / 2):
            x = np.append(begin, 0.0)
            x[dim] = rooms(begin)[2].min() - 0.1 * scale
            found = minimize(
                lambda x: -x[-1] / scale,
                x,
                jac=lambda x: -np.eye(dim + 1)[-1] / scale,
                method="SLSQP",
                constraints=[
                    {
                        "type": "ineq",
                        "fun": lambda x: (
                            np.concatenate([rooms(x[:dim])[0], rooms(x[:dim])[2] - x[dim]]) / scale
                        ),
                        "jac": lambda x: (
                            np.concatenate(
                                [
                                    np.pad(rooms(x[:dim])[1], ((0, 0), (0, 1))),
                                    np.pad(
                                        rooms(x[:dim])[3], ((0, 0), (0, 1)), constant_values=-1.0
                                    ),
                                ]
                            )
                            / scale
                        ),
                    }
                ],
                options={"maxiter": 200, "ftol": 1e-13},
            ).x[:dim]
            if np.isfinite(found).all():
                cut(found)
                slack, _, own, _ = rooms(found)
                if slack.min() >= -1e-7 * scale and own.min() > best:
                    best, inside = float(own.min()), found
        cut(inside)
        cost = -np.eye(dim + 1)[-1]
        least = min(float(each.min()) for each in self.depth)
        upper = np.inf
        for _ in range(300):
            solved = linprog(
                cost,
                np.array(matrix),
                np.array(offset),
                bounds=[*zip(self.low, self.high, strict=True), (None, None)],
            )
            if not solved.success:
                break
            upper, at = float(solved.x[dim]), solved.x[:dim]
            slack, _, own, _ = rooms(at)
            if slack.min() >= -1e-3 * least:
                best = max(best, float(own.min()))
            if upper - best <= 0.01 * least:
                break
            # Half of the way to the best point so far, too, which converges faster.
            cut(at)
            cut((at + inside) / 2)
        self.gap = upper - best
        return upper
