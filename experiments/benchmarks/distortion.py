"""What each flow does to actions that were allowed already, side by side.

`python experiments/benchmarks/distortion.py [--quick] [--output FOLDER]` takes regions that are r
times smaller than the action bounds around them, and regions of half-spaces, and measures of every
flow, by `cnfp_torchrl.audit.measure_distortion`, how far it moves allowed actions, the singular
values of its Jacobian on them, and the share of float32 samples that end on the boundary.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from cnfp_torchrl.audit import Distortion, measure_distortion
from cnfp_torchrl.geometry import Ball, Box, HalfSpaces, Region
from cnfp_torchrl.modules import (
    ExactFlow,
    Flow,
    ProjectionFlow,
    RadialFlow,
    RecessionFlow,
    SoftFlow,
)
from cnfp_torchrl.text_table import markdown_table

RESULTS = Path(__file__).resolve().parents[1] / "results"
LEAST_SLOPE = 1e-4
"""The slope at the end of a ray, r^-p, that the sharpness bounded by r keeps."""


def flows(divisor: float) -> dict[str, Flow]:
    """Return the flows, some of them for regions that are so many times smaller than the bounds."""
    bounded = min(8.0, max(1.0, -math.log(LEAST_SLOPE) / math.log(divisor)))
    return {
        "exact (hard)": ExactFlow(),
        "soft, p = 1": SoftFlow(1),
        "soft, p = 2": SoftFlow(2),
        "soft, p = 4": SoftFlow(4),
        f"soft, r^-p >= {LEAST_SLOPE:g}": SoftFlow(bounded),
        "radial": RadialFlow(),
        "projection": ProjectionFlow(),
        "recession": RecessionFlow(),
        "recession, s = 0.1": RecessionFlow(0.1),
    }


def balls(dim: int, divisor: float, count: int) -> Region:
    """Return balls of radius 1/r in the bounds [-1, 1]^d, about anchors beside their centers."""
    ones, radius = torch.ones(dim), 1 / divisor
    anchor = (1 - radius) * 0.6 * (2 * torch.rand(count, dim) - 1)
    beside = torch.nn.functional.normalize(torch.randn(count, dim), dim=-1) * (0.3 * radius)
    return Region((Box(-ones, ones), Ball(anchor + beside, torch.full((count,), radius))), anchor)


def barriers(dim: int, divisor: float, count: int) -> Region:
    """Return two half-spaces in [-1, 1]^d, at a distance of 1/r from the anchor."""
    ones = torch.ones(dim)
    anchor = 0.3 * (2 * torch.rand(count, dim) - 1)
    normals = torch.nn.functional.normalize(torch.randn(count, 2, dim) + 1, dim=-1)
    offsets = (normals * anchor.unsqueeze(-2)).sum(-1) + 1 / divisor
    return Region((Box(-ones, ones), HalfSpaces(normals, offsets)), anchor)


ABOUT = """\
# What flows do to actions that were allowed already

`python experiments/benchmarks/distortion.py`: regions r times smaller than the action bounds around
them (a ball of radius 1/r, or two half-spaces at a distance of 1/r from the anchor), 100 regions of
each, 200 allowed actions in each. Moved: as a share of the way from the anchor to the boundary.
Singular values: of the map from the action of the box squash to the final one, at allowed actions;
1 leaves them alone. On the boundary: share of the float32 samples of N(0, 1) latents that rounding
cannot tell from it. The recession needs half-spaces; its scale s is in action units.
"""

PROBLEMS = {"ball": balls, "barriers": barriers}


def measure(kind: str, dim: int, divisor: float, count: int) -> dict[str, Distortion]:
    """Return the distortion of every flow on the same regions."""
    torch.manual_seed(0)
    region = PROBLEMS[kind](dim, divisor, count)
    measured = {}
    for name, flow in flows(divisor).items():
        if kind == "barriers" or not isinstance(flow, RecessionFlow):
            torch.manual_seed(1)
            measured[name] = measure_distortion(flow, region, 200)
    return measured


def table(rows: list[dict[str, Any]]) -> str:
    """Return all measurements as a Markdown table."""
    head = ["set", "d", "r", "flow", "moved, median (95 %)", "smallest singular value (5 %)"]
    cells = [[*head, "largest (95 %)", "on the boundary"]]
    for row in rows:
        moved, smallest, largest = (row[name] for name in ("moved", "smallest", "largest"))
        cells.append(
            [
                *(row["set"], str(row["dim"]), f"{row['divisor']:g}", row["flow"]),
                f"{moved['median']:.2g} ({moved['q95']:.2g})",
                f"{smallest['median']:.2g} ({smallest['q05']:.2g})",
                f"{largest['median']:.3g} ({largest['q95']:.3g})",
                f"{100 * row['on_boundary']['share']:.1f} %",
            ]
        )
    return markdown_table(cells)


def main() -> None:
    """Measure and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="one small problem, for a test")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of distortion.md")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    problems = [(k, d, r) for k in PROBLEMS for d in (2, 6) for r in (4.0, 75.0, 250.0)]
    count = 100
    if arguments.quick:
        problems, count = [("barriers", 2, 4.0)], 3
    rows = []
    for kind, dim, divisor in problems:
        for name, found in measure(kind, dim, divisor, count).items():
            rows.append({"set": kind, "dim": dim, "divisor": divisor, "flow": name} | asdict(found))
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "distortion.json").write_text(json.dumps(rows, indent=1) + "\n")
    (arguments.output / "distortion.md").write_text(f"{ABOUT}\n{table(rows)}\n")
    print(table(rows))


if __name__ == "__main__":
    main()
