"""Time `lexicographic_anchor` beside the flow that uses its anchors, and beside qpax.

    python experiments/benchmarks/anchor_times.py [--quick] [--rounds 7] [--out FOLDER]

How the time grows with the batch, the dimension d and the number K of constraints, in states that
are roomy or tight, and with the share of states in which a constraint must give way: of balls,
boxes and half-spaces that lie apart (`lines.problem`), and of rows that face each other
(`facing_rows`), which is harder. The flow draws actions with their log-densities; qpax
(`pip install 'cnfp_torchrl[bench]'`) projects one action of each state onto the same bounds and
rows, of which there all can hold. In a round all take turns; processor time counts, which other
programs hardly change.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from interleaved import ROUNDS, Call, Rows, compared, processor, rounds, versions, write
from lines import drawn, problem
from torch import Tensor

from cnfp_torchrl.geometry import Ball, Box, ConstraintSet, HalfSpaces, Region, lexicographic_anchor
from cnfp_torchrl.text_table import markdown_table

RESULTS = Path(__file__).resolve().parents[1] / "results"
SCIPY = Path(__file__).with_name("anchors.json")
TIGHT = 0.05
"""The share of the states of facing rows whose best slack is some thousandths."""

NO_RELAXATION = ("anchors, easy", "anchors, 30 % tight", "anchors, 5 % tight")
"""The kinds of states in which all sets can hold: at most twice the flow's time is aimed at."""

MILLISECONDS = {16: 1.0, 4096: 4.0}
"""What is aimed at where all sets can hold, for batches of sets that lie apart."""

APART = [(16, 2, 2), (256, 2, 2), (4096, 2, 2), (256, 6, 2)]
"""Batch, dimension and number of constraints of sets that lie apart."""

FACING = [(16, 2, 2), (256, 2, 2), (4096, 2, 2), (256, 6, 1), (256, 8, 1), (256, 6, 4)]
"""The same of facing rows."""


def facing_rows(
    batch: int, dim: int, constraints: int, relaxed: float = 0.0
) -> list[ConstraintSet]:
    """Return bounds and constraints: eight rows if it is one, else balls and pairs of rows.

    Args:
        batch: The number of states.
        dim: The dimension of the actions.
        constraints: The number of constraints.
        relaxed: The share of the states in which one of them cannot hold.
    """
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(batch, *shape, generator=generator)

    def normal(*shape: int) -> Tensor:
        return torch.randn(batch, *shape, generator=generator)

    inside = uniform(dim) - 0.5
    tight = uniform(1) < TIGHT
    sets: list[ConstraintSet] = [Box(-torch.ones(dim), torch.ones(dim))]
    for k in range(constraints):
        slack = torch.where(tight, 0.002 + 0.008 * uniform(1), 0.1 + 0.4 * uniform(1))
        if k % 2 == 0 and constraints > 1:
            away = torch.nn.functional.normalize(normal(dim), dim=-1) * 0.5 * uniform(1)
            sets.append(Ball(inside + away, (away.norm(dim=-1, keepdim=True) + slack).squeeze(-1)))
            continue
        normals = normal(8 if constraints == 1 else 2, dim)
        offsets = (normals * inside.unsqueeze(1)).sum(-1) + slack * normals.norm(dim=-1)
        if k == min(1, constraints - 1):
            # Some rows are turned round and moved apart: two that face each other cannot both hold.
            impossible = torch.arange(batch) < round(relaxed * batch)
            facing = -normals[:, 0] + 0.05 * normals[:, 1]
            gap = -offsets[:, 0] - 0.3 * normals[:, 0].norm(dim=-1)
            normals[:, 1] = torch.where(impossible.unsqueeze(-1), facing, normals[:, 1])
            offsets[:, 1] = torch.where(impossible, gap, offsets[:, 1])
        sets.append(HalfSpaces(normals, offsets))
    return sets


def qpax_projection(sets: list[ConstraintSet]) -> Callable[[], Any]:
    """Return a call that projects an action of each state onto bounds and rows, compiled."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp
    import qpax

    rows = sets[1]
    assert isinstance(rows, HalfSpaces)
    batch, _, dim = rows.normals.shape
    identity = torch.eye(dim)
    sides = torch.cat([identity, -identity]).expand(batch, -1, -1)
    matrix = jnp.asarray(torch.cat([rows.normals, sides], 1).double().numpy())
    limits = jnp.asarray(torch.cat([rows.offsets, torch.ones(batch, 2 * dim)], 1).double().numpy())
    generator = torch.Generator().manual_seed(1)
    wish = jnp.asarray((2 * torch.rand(batch, dim, generator=generator) - 1).double().numpy())

    def project(wished: Any, left: Any, right: Any) -> Any:
        none = jnp.zeros((0, dim)), jnp.zeros(0)
        return qpax.solve_qp(jnp.eye(dim), -wished, *none, left, right)[0]

    compiled = jax.jit(jax.vmap(project))
    return lambda: compiled(wish, matrix, limits).block_until_ready()


def calls_of(case: tuple[int, int, int], *, facing: bool) -> dict[str, Call]:
    """Return what is timed for one size: the flow, and anchors of several kinds of states."""
    batch, dim, _ = case
    kinds: dict[str, Callable[[], list[ConstraintSet]]] = {
        "easy": lambda: problem(*case, tight=0.0),
        "30 % tight": lambda: problem(*case, tight=0.3),
        "1 % relaxed": lambda: problem(*case, tight=0.0, relaxed=0.01),
        "10 % relaxed": lambda: problem(*case, tight=0.0, relaxed=0.1),
    }
    if facing:
        shares = {"5 % tight": 0.0, "1 % relaxed": 0.01, "10 % relaxed": 0.1}
        kinds = {name: partial(facing_rows, *case, share) for name, share in shares.items()}
    calls: dict[str, Call] = {}
    for name, make in kinds.items():
        sets = make()
        if not calls:
            loc, scale = torch.zeros(batch, dim), torch.ones(batch, dim)
            calls["exact flow"] = partial(drawn, Region.build(sets), loc, scale)
        calls[f"anchors, {name}"] = partial(lexicographic_anchor, sets)
    return calls


@torch.no_grad()
def measure(cases: list[tuple[tuple[int, int, int], bool]], settings: Any) -> dict[str, Rows]:
    """Return the times of all sizes, beside the flow and, where rows are all there is, qpax."""
    results: dict[str, Rows] = {}
    for case, facing in cases:
        calls = calls_of(case, facing=facing)
        beside = facing and case[2] == 1 and settings.qpax
        if beside:
            calls["qpax"] = qpax_projection(facing_rows(*case))
        times = rounds(calls, settings.rounds, settings.seconds)
        batch, dim, count = case
        kind = "facing rows" if facing else "sets apart"
        title = f"{kind}, batch {batch}, d = {dim}, K = {count}"
        results[title] = compared(times, "exact flow")
        if beside:
            del times["exact flow"]
            first = {"qpax": times.pop("qpax")}
            results[f"{title}, beside qpax"] = compared({**first, **times}, "qpax")
    return results


def main() -> None:
    """Measure and write ``anchors.json`` and ``anchors.md``."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="two small problems, for a test")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    arguments.seconds, arguments.qpax = 0.1, bool(find_spec("qpax"))
    cases = [(case, False) for case in APART] + [(case, True) for case in FACING]
    if arguments.quick:
        arguments.rounds, arguments.seconds, arguments.qpax = 2, 1e-3, False
        cases = [((32, 2, 2), False), ((32, 2, 1), True)]
    elif not arguments.qpax:
        print("qpax is not installed (pip install 'cnfp_torchrl[bench]'): its rows are left out.")
    about = {
        "command": " ".join(["python experiments/benchmarks/anchor_times.py", *sys.argv[1:]]),
        "processor": f"{processor()}; the process's own time on it",
        "rounds": arguments.rounds,
        **versions("numpy", "qpax", "jax"),
        "load before, over 1, 5 and 15 minutes": _load(),
    }
    results = measure(cases, arguments)
    about["load after"] = _load()
    agreement = json.loads(SCIPY.read_text()).items()
    write(
        arguments.out / "anchors.json",
        "Measured: anchors",
        about,
        results,
        f"Of facing rows {TIGHT:.0%} of the states are tight in all mixes. On random sets, "
        "beside SciPy (`python experiments/benchmarks/anchors.py`): "
        + "; ".join(f"{key}: {value}" for key, value in agreement)
        + ".",
    )
    page = arguments.out / "anchors.md"
    page.write_text("\n".join([page.read_text().rstrip("\n"), "", *judged(results), ""]))
    sys.stdout.write(page.read_text())


def judged(results: dict[str, Rows]) -> list[str]:
    """Return a table of what was aimed at, what was measured, and what was missed by how much."""
    projection = next((rows["qpax"]["ms"] for rows in results.values() if "qpax" in rows), None)
    cells = [["what", "measured", "aim", ""]]

    def add(what: str, value: float, aim: float, unit: str) -> None:
        verdict = "met" if value <= aim else f"missed by {value / aim - 1:.0%}"
        cells.append([what, f"{value:.2f} {unit}", f"{aim:.2f} {unit}", verdict])

    for title, rows in results.items():
        for name, row in rows.items():
            what = f"{title}: {name}"
            if title.endswith("beside qpax"):
                if name != "qpax":
                    add(what, row["ratio"], 1.0, "of qpax's time")
            elif name in NO_RELAXATION:
                add(what, row["ratio"], 2.0, "of the flow's time")
            elif "apart" in title and "d = 6" in title and "relaxed" in name and projection:
                add(what, row["ms"], projection, "ms, as qpax for rows alone")
            for batch, most in MILLISECONDS.items():
                if title.startswith(f"sets apart, batch {batch},") and name in NO_RELAXATION:
                    add(what, row["ms"], most, "ms")
    return ["## Aims, met and missed", "", markdown_table(cells)]


def _load() -> str:
    return ", ".join(f"{load:.1f}" for load in os.getloadavg())


if __name__ == "__main__":
    main()
