"""Time sampling and scoring against TorchRL's TanhNormal and the usual ways to constrain actions.

`python experiments/benchmarks/flows.py [--quick] [--output FOLDER]` measures, on one thread, the
time of drawing reparametrized actions with their log-densities, and of that plus the backward pass,
for every batch size, dimension and number of constraints, and writes ratios to TanhNormal measured
in the same run. Distributions are constructed once, outside of the measured time, and in further
columns anew within it, as an actor does at each call. Compared are the exact flow, eager and
compiled; a radial squash whose log-determinant comes from the full Jacobian; and projections of the
tanh-squashed sample, which have no density, by Dykstra's algorithm and by a cvxpylayers program
(`pip install 'cnfp_torchrl[bench]'`; at the smaller batch size).
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import Any

import torch
from interleaved import rounds, versions
from torch import Tensor
from torch.distributions import Independent, Normal
from torch.func import jacrev, vmap
from torchrl.modules import TanhNormal

from cnfp_torchrl.bijectors import ExactSquash, RadialSquash
from cnfp_torchrl.distributions import ConstrainedFlow
from cnfp_torchrl.geometry import Ball, Box, ConstraintSet, Region
from cnfp_torchrl.text_table import markdown_table

ROUNDS = 11
RESULTS = Path(__file__).resolve().parents[1] / "results"
Sample = tuple[Tensor, ...]


@dataclass(frozen=True)
class Problem:
    """Base parameters and sets of a batch of states: balls and boxes, which bind."""

    loc: Tensor
    scale: Tensor
    low: Tensor
    high: Tensor
    anchor: Tensor
    balls: tuple[tuple[Tensor, Tensor], ...]
    boxes: tuple[tuple[Tensor, Tensor], ...]
    active: Tensor

    @classmethod
    def random(cls, batch: int, dim: int, constraints: int) -> Problem:
        """Return a problem with a known anchor."""
        anchor = (0.1 * torch.randn(batch, dim)).clamp(-0.3, 0.3)
        balls = tuple(
            (anchor + 0.1 / dim**0.5, 0.3 * dim**0.5 + torch.rand(batch))
            for _ in range(0, constraints, 2)
        )
        boxes = tuple(
            (anchor - 0.1 - torch.rand(batch, dim), anchor + 0.1 + torch.rand(batch, dim))
            for _ in range(1, constraints, 2)
        )
        return cls(
            torch.randn(batch, dim, requires_grad=True),
            (0.1 + torch.rand(batch, dim)).requires_grad_(),
            -torch.ones(dim),
            torch.ones(dim),
            anchor,
            balls,
            boxes,
            torch.ones(batch, constraints + 1, dtype=torch.bool),
        )

    def base(self) -> Independent[Normal]:
        """Return the Gaussian."""
        normal = Normal(self.loc, self.scale, validate_args=False)
        return Independent(normal, 1, validate_args=False)

    def region(self) -> Region:
        """Return the region, its sets unchecked."""
        sets: list[ConstraintSet] = [Ball(*ball, validate_args=False) for ball in self.balls]
        sets += [Box(*box, validate_args=False) for box in self.boxes]
        bounds = Box(self.low, self.high, validate_args=False)
        return Region((bounds, *sets), self.anchor, self.active, validate_args=False)


def tanh_normal(p: Problem) -> TanhNormal:
    """Return TorchRL's distribution, which knows the action bounds only."""
    return TanhNormal(p.loc, p.scale, low=p.low, high=p.high)


def exact_flow(p: Problem) -> ConstrainedFlow:
    """Return the exact flow."""
    return ConstrainedFlow(p.base(), ExactSquash(p.region(), validate_args=False))


def radial_full_jacobian(p: Problem) -> Sample:
    """Return a sample of a radial squash, its determinant by automatic differentiation."""
    base, region = p.base(), p.region()

    count = len(p.balls)

    def one(latent: Tensor, anchor: Tensor, *fields: tuple[Tensor, Tensor]) -> Tensor:
        balls = [Ball(*values, validate_args=False) for values in fields[:count]]
        boxes = [Box(*values, validate_args=False) for values in fields[count:]]
        sets = (region.bounds, *balls, *boxes)
        return RadialSquash(Region(sets, anchor, validate_args=False))(latent)

    latent = base.rsample()
    jacobian = vmap(jacrev(one))(latent, p.anchor, *p.balls, *p.boxes)
    log_det = torch.linalg.slogdet(jacobian)[1]
    return RadialSquash(region)(latent), base.log_prob(latent) - log_det


def dykstra(p: Problem, iterations: int = 50) -> Sample:
    """Return the tanh-squashed sample projected onto the intersection; it has no density."""
    action = tanh_normal(p).rsample_and_log_prob()[0]
    corrections = [torch.zeros_like(action) for _ in range(1 + len(p.balls) + len(p.boxes))]
    for _ in range(iterations):
        for k, correction in enumerate(corrections):
            moved = action + correction
            if k == 0:
                action = moved.clamp(p.low, p.high)
            elif k <= len(p.balls):
                center, radius = p.balls[k - 1]
                offset = moved - center
                excess = (offset.norm(dim=-1) / radius).clamp(min=1).unsqueeze(-1)
                action = center + offset / excess
            else:
                low, high = p.boxes[k - 1 - len(p.balls)]
                action = torch.minimum(torch.maximum(moved, low), high)
            corrections[k] = moved - action
    return (action,)


def cvxpy_projection(p: Problem) -> Callable[[], Sample]:
    """Return a call of the tanh-squashed sample's projection by a differentiable cone program."""
    import cvxpy
    from cvxpylayers.torch import CvxpyLayer

    dim = p.loc.shape[-1]
    action, wish = cvxpy.Variable(dim), cvxpy.Parameter(dim)
    centers = [cvxpy.Parameter(dim) for _ in p.balls]
    radii = [cvxpy.Parameter(nonneg=True) for _ in p.balls]
    sides = [(cvxpy.Parameter(dim), cvxpy.Parameter(dim)) for _ in p.boxes]
    constraints = [action >= p.low.numpy(), action <= p.high.numpy()]
    constraints += [cvxpy.norm(action - m) <= r for m, r in zip(centers, radii, strict=True)]
    constraints += [row for low, high in sides for row in (action >= low, action <= high)]
    program = cvxpy.Problem(cvxpy.Minimize(cvxpy.sum_squares(action - wish)), constraints)
    flat = [side for pair in sides for side in pair]
    layer = CvxpyLayer(program, parameters=[wish, *centers, *radii, *flat], variables=[action])
    values = [m for m, _ in p.balls] + [r for _, r in p.balls]
    values += [side for pair in p.boxes for side in pair]
    return lambda: (layer(tanh_normal(p).rsample_and_log_prob()[0], *values)[0],)


def measure(
    batch: int, dim: int, constraints: int, *, quick: bool = False, eager: bool = False
) -> dict[str, Any]:
    """Return forward and forward-plus-backward times of each method on one problem."""
    p = Problem.random(batch, dim, constraints)
    tanh, exact = tanh_normal(p), exact_flow(p)
    calls: dict[str, Callable[[], Sample]] = {
        "TanhNormal": lambda: tanh.rsample_and_log_prob(),
        "exact": lambda: exact.rsample_and_log_prob(),
        "TanhNormal, constructed": lambda: tanh_normal(p).rsample_and_log_prob(),
        "exact, constructed": lambda: exact_flow(p).rsample_and_log_prob(),
        "Dykstra, 50 rounds": lambda: dykstra(p),
    }
    if batch * dim <= 4096:
        calls["radial, full Jacobian"] = lambda: radial_full_jacobian(p)
    if not (quick or eager):
        for name in ("TanhNormal", "exact", "TanhNormal, constructed", "exact, constructed"):
            calls[f"{name}, compiled"] = torch.compile(calls[name])
    if not quick and find_spec("cvxpylayers") and batch <= 256:
        calls["cvxpylayers"] = cvxpy_projection(p)

    def with_backward(call: Callable[[], Sample]) -> Callable[[], None]:
        return lambda: torch.stack([part.sum() for part in call()]).sum().backward()

    row: dict[str, Any] = {"batch": batch, "dim": dim, "constraints": constraints}
    seconds = (0.02 if quick else 0.5) / ROUNDS
    sample = rounds(calls, ROUNDS, seconds)
    backward = rounds({n: with_backward(call) for n, call in calls.items()}, ROUNDS, seconds)
    for name in calls:
        row[name] = {
            part: {
                "ms": 1e3 * median(times[name]),
                "ratio": _ratio(times[name], times[_reference(name)]),
            }
            for part, times in (("sample", sample), ("backward", backward))
        }
    torch.compiler.reset()
    return row


def _reference(name: str) -> str:
    """Return the TanhNormal that is constructed and compiled alike."""
    return name.replace("exact", "TanhNormal") if name.startswith("exact") else "TanhNormal"


def _ratio(times: list[float], reference: list[float]) -> float:
    return median(time / other for time, other in zip(times, reference, strict=True))


def table(rows: list[dict[str, Any]], part: str) -> str:
    """Return ratios to the TanhNormal that is constructed and compiled alike, as Markdown."""
    methods = dict.fromkeys(n for row in rows for n in row if isinstance(row[n], dict))
    names = [n for n in methods if not n.startswith("TanhNormal")]
    lines = [["batch", "d", "K", "TanhNormal, ms", *names]]
    for row in rows:
        cells = [str(row[key]) for key in ("batch", "dim", "constraints")]
        cells.append(f"{row['TanhNormal'][part]['ms']:.3f}")
        for name in names:
            ratio = row[name][part]["ratio"] if name in row else None
            cells.append("" if ratio is None else f"{ratio:.2f}" if ratio < 100 else f"{ratio:.0f}")
        lines.append(cells)
    return markdown_table(lines)


def main() -> None:
    """Measure and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="one small problem, for a test")
    parser.add_argument("--eager", action="store_true", help="without what has to be compiled")
    parser.add_argument("--batches", type=int, nargs="+", default=[256, 4096])
    parser.add_argument("--dims", type=int, nargs="+", default=[2, 6, 32])
    parser.add_argument("--constraints", type=int, nargs="+", default=[1, 2, 8])
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of flows.json and .md")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    batches, dims, counts = arguments.batches, arguments.dims, arguments.constraints
    if arguments.quick:
        batches, dims, counts = [8], [2], [2]
    rows = []
    for batch in batches:
        for dim in dims:
            for constraints in counts:
                how = {"quick": arguments.quick, "eager": arguments.eager}
                rows.append(measure(batch, dim, constraints, **how))
                print(json.dumps(rows[-1]), flush=True)
    about = {"processor": platform.machine(), **versions("cvxpylayers")}
    arguments.output.mkdir(parents=True, exist_ok=True)
    document = {"about": about, "unit": "ms", "rows": rows}
    (arguments.output / "flows.json").write_text(json.dumps(document, indent=1) + "\n")
    text = "\n".join(
        [
            "# Time of sampling and scoring, as a ratio to TanhNormal",
            "",
            f"`python experiments/benchmarks/flows.py {' '.join(sys.argv[1:])}".rstrip() + "`",
            "",
            f"One thread, {about}.",
            "",
            "Compared with a TanhNormal that is constructed and compiled alike: once, or anew at "
            "each call where it says constructed. Medians, of the process's own time on the "
            "processor, over rounds in which all take turns.",
            "",
            "## Drawing an action and its log-density",
            "",
            table(rows, "sample"),
            "",
            "## The same and its backward pass",
            "",
            table(rows, "backward"),
            "",
        ]
    )
    (arguments.output / "flows.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
