"""Time `lexicographic_anchor` beside the flow that uses its anchors, and beside qpax.

    python experiments/benchmarks/anchor_times.py [--quick] [--before FILE] [--output FOLDER]

How the time grows with the batch, the dimension d and the number K of constraints, in states that
are roomy or tight, and with the share of states in which a constraint must give way. The flow draws
actions with their log-densities; qpax (`pip install 'cnfp_torchrl[bench]'`) projects one action of
each state onto the same bounds and rows, of which there all can hold. In a round all take turns;
processor time counts, which other programs hardly change. `--before` takes an ``anchors.json`` that
this script wrote beside an older library.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from interleaved import compared, processor, rounds, versions
from torch import Tensor
from torch.distributions import Independent, Normal

from cnfp_torchrl.bijectors import ExactSquash
from cnfp_torchrl.distributions import ConstrainedFlow
from cnfp_torchrl.geometry import Ball, Box, ConstraintSet, HalfSpaces, Region, lexicographic_anchor

RESULTS = Path(__file__).resolve().parents[1] / "results"
SCIPY = Path(__file__).with_name("anchors.json")
TIGHT = 0.05
"""The share of the states whose best slack is some thousandths."""

GROWTH = [(16, 2, 2), (256, 2, 2), (4096, 2, 2), (256, 6, 1), (256, 8, 1), (256, 6, 4)]
"""Batch, dimension and number of constraints of the problems without a state to relax."""

SHARES = [(256, 2, 2), (256, 6, 1)]
"""The same of those in which 1 % and 10 % of the states are relaxed."""


def problem(batch: int, dim: int, constraints: int, relaxed: float = 0.0) -> list[ConstraintSet]:
    """Return bounds and constraints: eight rows if it is one, else balls and pairs of rows.

    Args:
        batch: number of states.
        dim: dimension of the actions.
        constraints: number of constraints.
        relaxed: share of the states in which one of them cannot hold.
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


def flow_of(sets: list[ConstraintSet]) -> Callable[[], Any]:
    """Return a call that draws one action in each state, with its log-density."""
    region = Region.build(sets)
    base = Normal(torch.zeros_like(region.anchor), 1.0, validate_args=False)
    squash = ExactSquash(region, validate_args=False)
    return ConstrainedFlow(Independent(base, 1, validate_args=False), squash).rsample_and_log_prob


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


def measure(
    case: tuple[int, int, int], relaxed: float, count: int, seconds: float, *, quick: bool
) -> dict[str, Any]:
    """Return the times of anchors and flow, of qpax where there are rows alone, and ratios."""
    sets = problem(*case, relaxed)
    calls: dict[str, Callable[[], Any]] = {
        "anchor": lambda: lexicographic_anchor(sets),
        "flow": flow_of(sets),
    }
    if relaxed and case[2] == 1 and not quick and find_spec("qpax"):
        calls["qpax"] = qpax_projection(problem(*case))
    times = rounds(calls, count, seconds)
    given = (~lexicographic_anchor(sets).active.all(-1)).double().mean().item()
    row: dict[str, Any] = dict(zip(("batch", "dim", "constraints"), case, strict=True))
    row |= {"relaxed": given}
    row["ms"] = {name: found["ms"] for name, found in compared(times, "anchor").items()}
    for other in set(times) - {"anchor"}:
        ratio = compared(times, other)["anchor"]
        row[f"/ {other}"] = {name: ratio[name] for name in ("ratio", "low", "high")}
    return row


def table(rows: list[dict[str, Any]], before: list[dict[str, Any]]) -> list[str]:
    """Return the results as Markdown."""
    lines = [
        "| batch | d | K | relaxed | anchor, ms | before, ms | flow, ms | / flow | quartiles "
        "| / qpax |",
        "|" + "---|" * 10,
    ]
    for i, row in enumerate(rows):
        ratio, qpax = row["/ flow"], row.get("/ qpax")
        old = f"{before[i]['ms']['anchor']:.2f}" if before else ""
        lines.append(
            f"| {row['batch']} | {row['dim']} | {row['constraints']} | {row['relaxed']:.0%} | "
            f"{row['ms']['anchor']:.2f} | {old} | {row['ms']['flow']:.2f} | {ratio['ratio']:.1f} | "
            f"{ratio['low']:.1f} to {ratio['high']:.1f} | "
            + (f"{qpax['ratio']:.1f} of {row['ms']['qpax']:.2f} ms |" if qpax else "|")
        )
    return lines


def main() -> None:
    """Measure and write ``anchors.json`` and ``anchors.md``."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="one small problem, for a test")
    parser.add_argument("--rounds", type=int, default=9, help="rounds in which all take turns")
    parser.add_argument("--before", type=Path, help="anchors.json of an older library, by this")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the results")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    cases = [(case, 0.0) for case in GROWTH]
    cases += [(case, share) for case in SHARES for share in (0.01, 0.1)]
    count, seconds = arguments.rounds, 0.1
    if arguments.quick:
        cases, count, seconds = [((8, 2, 2), 0.0), ((8, 2, 1), 0.25)], 2, 1e-3
    if not find_spec("qpax"):
        print("qpax is not installed (pip install 'cnfp_torchrl[bench]'): its column stays empty.")
    rows = [measure(case, share, count, seconds, quick=arguments.quick) for case, share in cases]
    about = {
        "command": " ".join(["python experiments/benchmarks/anchor_times.py", *sys.argv[1:]]),
        "processor": processor(),
        "rounds": count,
        "load": os.getloadavg()[0],
        **versions("numpy", "qpax", "jax"),
    }
    arguments.output.mkdir(parents=True, exist_ok=True)
    document = {"about": about, "rows": rows}
    (arguments.output / "anchors.json").write_text(json.dumps(document, indent=1) + "\n")
    before = json.loads(arguments.before.read_text())["rows"] if arguments.before else []
    lines = ["# Time of anchors", "", *(f"- {key}: {value}" for key, value in about.items()), ""]
    lines += [
        "Medians over rounds in which all take turns; ratios are taken within a round. Processor "
        "time of all threads. One constraint is eight rows, more are balls and pairs of rows; "
        f"{TIGHT:.0%} of the states are tight. qpax projects one action of each state onto the "
        "same rows where all can hold.",
        "",
        *table(rows, before),
        "",
        "On random intersections, beside SciPy (`python experiments/benchmarks/anchors.py`):",
        "",
        *(f"- {key}: {value}" for key, value in json.loads(SCIPY.read_text()).items()),
        "",
    ]
    text = "\n".join(lines)
    (arguments.output / "anchors.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
