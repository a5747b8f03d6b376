"""Time layers that turn wished actions into allowed ones, and count what they leave broken.

    pip install 'cnfp_torchrl[bench]' pinet-hcnn && pip install --no-deps qpth
    python experiments/benchmarks/layers.py [--quick] [--rounds 5] [--output FOLDER]

Three problems in float64: eight rows inside the bounds of six components (a quadratic program a
state), a ball inside them, and limits of rate. Each layer gets a batch of wished actions, the same
for all, and returns allowed ones; then the gradient of their squares goes back to the wishes. Sets
are given, and with "searched" the anchor is searched for in every call. In a round all take turns;
processor time counts. Broken is told of all actions, in float64: beyond a boundary by more than 0,
and by more than 1e-6.

The peers are what their packages are by default, each compiled or set up before as far as it lets:
Pinet (Grontas et al. 2025, arXiv 2508.10480) with its matrices fixed, as it compiles them in, and
50 iterations; OSQP one program after the other; SRad, a radial squash with the determinant of its
dense Jacobian (Kasaura et al. 2023, arXiv 2304.08743). What is not installed is left out and told.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from anchor_times import facing_rows
from interleaved import Rows, compared, processor, rounds, versions, write
from torch import Tensor
from torch.func import jacrev, vmap

from cnfp_torchrl.bijectors import RadialSquash
from cnfp_torchrl.geometry import (
    Ball,
    Box,
    ConstraintSet,
    HalfSpaces,
    Region,
    project_onto_intersection,
)
from cnfp_torchrl.modules import ConstraintLayer, ExactFlow, Flow, GaugeFlow

RESULTS = Path(__file__).resolve().parents[1] / "results"
PEERS = ("pinet", "qpax", "proxsuite", "osqp", "qpth", "cvxpylayers")
ITERATIONS, BACKWARD_ITERATIONS = 50, 25
"""Pinet's, as in its paper's experiments."""

Solve = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Layer:
    """A layer on one batch of wished actions.

    Args:
        forward: The function that returns allowed actions.
        backward: The function that computes them, and the gradient of the sum of their squares;
            None without one.
    """

    forward: Callable[[], Any]
    backward: Callable[[], Any] | None


def of_torch(solve: Solve, wished: Tensor) -> Layer:
    """Return the layer of a function of tensors that has gradients."""

    def backward() -> Tensor | None:
        given = wished.clone().requires_grad_()
        solve(given).square().sum().backward()
        return given.grad

    def forward() -> Tensor:
        with torch.no_grad():
            return solve(wished)

    return Layer(forward, backward)


def of_jax(solve: Callable[[Any], Any], wished: Tensor) -> Layer:
    """Return the layer of a function of JAX's arrays, compiled."""
    import jax

    given = jax.numpy.asarray(wished.numpy())
    forward = jax.jit(solve)
    backward = jax.jit(jax.value_and_grad(lambda w: (solve(w) ** 2).sum()))
    return Layer(
        lambda: forward(given).block_until_ready(), lambda: jax.block_until_ready(backward(given))
    )


def rows_of(sets: list[ConstraintSet]) -> tuple[Tensor, Tensor]:
    """Return all rows, those of the bounds last, ``(n, m, d)`` and ``(n, m)``."""
    rows = sets[1]
    assert isinstance(rows, HalfSpaces)
    count, _, dim = rows.normals.shape
    identity = torch.eye(dim, dtype=rows.dtype)
    sides = torch.cat([identity, -identity]).expand(count, -1, -1)
    ones = torch.ones(count, 2 * dim, dtype=rows.dtype)
    return torch.cat([rows.normals, sides], 1), torch.cat([rows.offsets, ones], 1)


# Ours ---------------------------------------------------------------------------------------------


def flow_solver(flow: Flow, sets: list[ConstraintSet], region: Region | None) -> Solve:
    """Return a flow of latents, with its log-density; None searches for the anchor."""

    def solve(latent: Tensor) -> Tensor:
        return flow(region or Region.build(sets)).forward_and_log_det(latent)[0]

    return solve


def layer_solver(name: str, sets: list[ConstraintSet], region: Region | None) -> Solve:
    """Return a `ConstraintLayer` of wished actions; None searches for the anchor."""
    layer = ConstraintLayer(name)
    return lambda wished: layer(wished, region or Region.build(sets))


def ours(sets: list[ConstraintSet], wished: Tensor, *, with_rows: bool) -> dict[str, Layer]:
    """Return our layers, with the anchor known and searched for."""
    known = Region.build(sets)
    found: dict[str, Layer] = {}
    for suffix, region in (("", known), (", anchor searched", None)):
        for name, flow in (("exact", ExactFlow()), ("gauge", GaugeFlow())):
            found[f"{name}{suffix}"] = of_torch(flow_solver(flow, sets, region), wished)
        for name in ("soft", "recession") if with_rows else ("soft",):
            found[f"{name}{suffix}"] = of_torch(layer_solver(name, sets, region), wished)
    return found


def projected(sets: list[ConstraintSet], region: Region) -> Solve:
    """Return our projection, in closed form where there is one."""
    return lambda wished: project_onto_intersection(region, wished, 50)


def srad(sets: list[ConstraintSet], region: Region) -> Solve:
    """Return a radial squash with the log-determinant of its dense Jacobian."""
    names = [list(part.fields()) for part in sets]
    kinds = [type(part) for part in sets]

    def squash(latent: Tensor, anchor: Tensor, *fields: tuple[Tensor, ...]) -> Tensor:
        parts = [
            kind(**dict(zip(name, values, strict=True)), validate_args=False)
            for kind, name, values in zip(kinds, names, fields, strict=True)
        ]
        region = Region(parts, anchor, validate_args=False)
        return RadialSquash(region, validate_args=False)(latent)

    shape = region.anchor.shape[:-1]
    fields = [
        tuple(
            value.expand(*shape, *value.shape[value.ndim - part.event_dims[name] :])
            for name, value in part.fields().items()
        )
        for part in sets
    ]

    def solve(latent: Tensor) -> Tensor:
        jacobian = vmap(jacrev(squash))(latent, region.anchor, *fields)
        # 0 in value, so that the determinant is paid for, forward and backward.
        determinant = torch.linalg.slogdet(jacobian)[1]
        return RadialSquash(region)(latent) + 0 * determinant.unsqueeze(-1)

    return solve


# Peers --------------------------------------------------------------------------------------------


def pinet_layer(sets: list[ConstraintSet], wished: Tensor) -> Layer:
    """Return Pinet's projection."""
    import jax.numpy as jnp
    from pinet import (
        AffineInequalityConstraint,
        BoxConstraint,
        BoxConstraintSpecification,
        Project,
        ProjectionInstance,
    )

    rows = sets[1]
    assert isinstance(rows, HalfSpaces)
    limits = jnp.asarray(rows.offsets.numpy())[..., None]
    ones = jnp.ones((1, wished.shape[-1], 1))
    project = Project(
        ineq_constraint=AffineInequalityConstraint(
            jnp.asarray(rows.normals.numpy()), jnp.full(limits.shape, -jnp.inf), limits
        ),
        box_constraint=BoxConstraint(BoxConstraintSpecification(lb=-ones, ub=ones)),
    )

    def solve(given: Any) -> Any:
        point = ProjectionInstance(x=given[..., None])
        result, _ = project.call(y_raw=point, n_iter=ITERATIONS, n_iter_bwd=BACKWARD_ITERATIONS)
        return result.x[..., 0]

    return of_jax(solve, wished)


def qpax_layer(sets: list[ConstraintSet], wished: Tensor) -> Layer:
    """Return qpax's program."""
    import jax
    import jax.numpy as jnp
    import qpax

    matrix, limits = (jnp.asarray(part.numpy()) for part in rows_of(sets))
    dim = wished.shape[-1]

    def project(wish: Any, left: Any, right: Any) -> Any:
        none = jnp.zeros((0, dim)), jnp.zeros(0)
        return qpax.solve_qp_primal(jnp.eye(dim), -wish, *none, left, right)

    return of_jax(lambda given: jax.vmap(project)(given, matrix, limits), wished)


def proxsuite_layer(sets: list[ConstraintSet], wished: Tensor) -> Layer:
    """Return ProxQP's layer for PyTorch."""
    from proxsuite.torch.qplayer import QPFunction

    matrix, limits = rows_of(sets)
    count, dim = wished.shape
    identity = torch.eye(dim, dtype=wished.dtype).expand(count, dim, dim)
    none = wished.new_zeros(count, 0, dim), wished.new_zeros(count, 0)
    lowest = torch.full_like(limits, -1e20)
    layer = QPFunction(omp_parallel=False)
    return of_torch(lambda w: layer(identity, -w, *none, matrix, lowest, limits)[0], wished)


def qpth_layer(sets: list[ConstraintSet], wished: Tensor) -> Layer:
    """Return qpth's layer."""
    from qpth.qp import QPFunction

    matrix, limits = rows_of(sets)
    count, dim = wished.shape
    identity = torch.eye(dim, dtype=wished.dtype).expand(count, dim, dim)
    none = wished.new_empty(0)
    layer = QPFunction(verbose=False, check_Q_spd=False)
    return of_torch(lambda w: layer(identity, -w, matrix, limits, none, none), wished)


def osqp_layer(sets: list[ConstraintSet], wished: Tensor) -> Layer:
    """Return OSQP, one program after the other; each is set up once, and then updated."""
    import osqp
    from scipy.sparse import csc_matrix

    matrix, limits = (part.numpy() for part in rows_of(sets))
    solvers = []
    for left, right in zip(matrix, limits, strict=True):
        solver = osqp.OSQP()
        identity = csc_matrix(np.eye(left.shape[-1]))
        lowest = np.full_like(right, -np.inf)
        solver.setup(
            identity,
            np.zeros(len(identity.indptr) - 1),
            csc_matrix(left),
            lowest,
            right,
            verbose=False,
            warm_starting=False,
        )
        solvers.append(solver)

    def forward() -> np.ndarray:
        found = []
        for solver, wish in zip(solvers, wished.numpy(), strict=True):
            solver.update(q=-wish)
            found.append(solver.solve().x)
        return np.stack(found)

    return Layer(forward, None)


def cvxpylayers_layer(sets: list[ConstraintSet], wished: Tensor) -> Layer:
    """Return a differentiable cone program."""
    import cvxpy
    from cvxpylayers.torch import CvxpyLayer

    matrix, limits = rows_of(sets)
    action, wish = (make(wished.shape[-1]) for make in (cvxpy.Variable, cvxpy.Parameter))
    left, right = cvxpy.Parameter(matrix.shape[1:]), cvxpy.Parameter(limits.shape[1:])
    goal = cvxpy.Minimize(cvxpy.sum_squares(action - wish))
    layer = CvxpyLayer(cvxpy.Problem(goal, [left @ action <= right]), [wish, left, right], [action])
    return of_torch(lambda w: layer(w, matrix, limits)[0], wished)


def peers(sets: list[ConstraintSet], wished: Tensor, skip: tuple[str, ...]) -> dict[str, Layer]:
    """Return the installed peers that project onto rows."""
    makers = {
        "Pinet": ("pinet", pinet_layer),
        "qpax": ("qpax", qpax_layer),
        "ProxQP": ("proxsuite", proxsuite_layer),
        "OSQP": ("osqp", osqp_layer),
        "qpth": ("qpth", qpth_layer),
        "cvxpylayers": ("cvxpylayers", cvxpylayers_layer),
    }
    return {
        name: maker(sets, wished)
        for name, (package, maker) in makers.items()
        if find_spec(package) and package not in skip
    }


# The table ----------------------------------------------------------------------------------------


def broken(sets: list[ConstraintSet], actions: Any) -> dict[str, float]:
    """Return the shares of actions beyond a boundary by more than 0 and by more than 1e-6."""
    given = actions if isinstance(actions, Tensor) else torch.from_numpy(np.array(actions))
    excess = torch.stack([-part.slack(given) for part in sets]).amax(0)
    inside = torch.stack([part.contains(given) for part in sets]).all(0)
    return {
        "broken, %": 100 * float((~inside).double().mean()),
        "by 1e-6, %": 100 * float((excess > 1e-6).double().mean()),
    }


def problems(batch: int, skip: tuple[str, ...]) -> dict[str, tuple[list[Any], dict[str, Layer]]]:
    """Return the sets and the layers of each problem."""
    random = torch.Generator().manual_seed(1)
    wished = 1.5 * torch.randn(batch, 6, generator=random, dtype=torch.float64)
    found = {}
    rows = [part.to(torch.float64) for part in facing_rows(batch, 6, 1)]
    region = Region.build(rows)
    layers = ours(rows, wished, with_rows=True)
    layers["Dykstra, 50 rounds"] = of_torch(projected(rows, region), wished)
    layers["SRad, dense Jacobian"] = of_torch(srad(rows, region), wished)
    found[f"Eight rows in six dimensions, {batch} states"] = (
        rows,
        layers | peers(rows, wished, skip),
    )
    middle = torch.rand(batch, 6, generator=random, dtype=torch.float64) - 0.5
    radius = 0.3 + torch.rand(batch, generator=random, dtype=torch.float64)
    bounds = rows[0]
    last = 2 * torch.rand(batch, 6, generator=random, dtype=torch.float64) - 1
    for title, part in (
        ("A ball", Ball(middle, radius)),
        ("Limits of rate", Box(last - 0.3, last + 0.3)),
    ):
        sets = [bounds, part]
        region = Region.build(sets)
        layers = ours(sets, wished, with_rows=False)
        layers["projection, closed form"] = of_torch(projected(sets, region), wished)
        layers["SRad, dense Jacobian"] = of_torch(srad(sets, region), wished)
        found[f"{title} in six dimensions, {batch} states"] = sets, layers
    return found


def measure(
    sets: list[ConstraintSet], layers: dict[str, Layer], count: int, seconds: float
) -> Rows:
    """Return a row for each layer."""
    first = next(iter(layers))
    forward = compared(rounds({n: e.forward for n, e in layers.items()}, count, seconds), first)
    calls = {n: e.backward for n, e in layers.items() if e.backward is not None}
    both = compared(rounds(calls, count, seconds), first)
    rows: Rows = {}
    for name, layer in layers.items():
        row = dict(forward[name])
        if name in both:
            row |= {f"{key}, both": both[name][key] for key in ("ms", "ratio", "low", "high")}
        rows[name] = {**row, **broken(sets, layer.forward())}
    return rows


def main() -> None:
    """Measure and write ``layers.json`` and ``layers.md``."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="a few states, for a test")
    parser.add_argument("--rounds", type=int, default=5, help="rounds in which all take turns")
    parser.add_argument("--batch", type=int, nargs="+", default=[16, 256], help="states")
    parser.add_argument("--skip", nargs="*", choices=PEERS, default=[], help="peers to leave out")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the results")
    given = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    if find_spec("jax"):
        import jax

        jax.config.update("jax_enable_x64", True)
    batches, count, seconds = given.batch, given.rounds, 0.1
    if given.quick:
        batches, count, seconds = [4], 2, 1e-3
    results = {
        title: measure(sets, layers, count, seconds)
        for batch in batches
        for title, (sets, layers) in problems(batch, tuple(given.skip)).items()
    }
    missing = [name for name in PEERS if not find_spec(name) or name in given.skip]
    about = {
        "command": " ".join(["python experiments/benchmarks/layers.py", *sys.argv[1:]]),
        "processor": processor(),
        "rounds": count,
        "load": os.getloadavg()[0],
        **versions(
            "numpy", "qpax", "jax", "pinet-hcnn", "proxsuite", "osqp", "qpth", "cvxpylayers"
        ),
        "not measured": ", ".join(missing) or "none",
    }
    write(
        given.output / "layers.json",
        "Layers alone",
        about,
        results,
        "Float64, processor time of all threads. Both: forward and backward. Soft and recession "
        "take wished actions, exact and gauge latents, with their log-densities. Broken: actions "
        "that lie outside, at all and by more than 1e-6.",
    )


if __name__ == "__main__":
    main()
