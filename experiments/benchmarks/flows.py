"""Time sampling and scoring against TorchRL's TanhNormal and the usual ways to constrain actions.

`python experiments/benchmarks/flows.py [--quick] [--output FOLDER]` measures, on one thread, the
time of drawing reparametrised actions with their log-densities, and of that plus the backward pass,
for every batch size, dimension and number of constraints, and writes ratios to TanhNormal measured
in the same run. Distributions, regions and sets are constructed within the measured time, as an
actor does at each call. Compared are the exact flow, eager and compiled; a radial squash whose
log-determinant comes from the full Jacobian; and projections of the tanh-squashed sample, which
have no density, by Dykstra's algorithm and by a cvxpylayers program (if it is installed).
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Independent, Normal
from torch.func import jacrev, vmap
from torch.utils.benchmark import Timer
from torchrl.modules import TanhNormal

from cnfp_torchrl.bijectors import GaugeSquash, RadialSquash
from cnfp_torchrl.distributions import ConstrainedFlow
from cnfp_torchrl.geometry import Ball, Box, ConstraintSet, Region

RESULTS = Path(__file__).resolve().parents[1] / "results"
Sample = tuple[Tensor, ...]


@dataclass(frozen=True)
class Problem:
    """Base parameters and sets of a batch of states: balls and boxes, which bind."""

    loc: Tensor
    scale: Tensor
    low: Tensor
    high: Tensor
    centre: Tensor
    balls: tuple[tuple[Tensor, Tensor], ...]
    boxes: tuple[tuple[Tensor, Tensor], ...]
    active: Tensor

    @classmethod
    def random(cls, batch: int, dim: int, constraints: int) -> Problem:
        """Return a problem with a known centre."""
        centre = (0.1 * torch.randn(batch, dim)).clamp(-0.3, 0.3)
        balls = tuple(
            (centre + 0.1 / dim**0.5, 0.3 * dim**0.5 + torch.rand(batch))
            for _ in range(0, constraints, 2)
        )
        boxes = tuple(
            (centre - 0.1 - torch.rand(batch, dim), centre + 0.1 + torch.rand(batch, dim))
            for _ in range(1, constraints, 2)
        )
        return cls(
            torch.randn(batch, dim, requires_grad=True),
            (0.1 + torch.rand(batch, dim)).requires_grad_(),
            -torch.ones(dim),
            torch.ones(dim),
            centre,
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
        return Region((bounds, *sets), self.centre, self.active, validate_args=False)


def tanh_normal(p: Problem) -> Sample:
    """TorchRL's distribution, which knows the action bounds only."""
    return TanhNormal(p.loc, p.scale, low=p.low, high=p.high).rsample_and_log_prob()


def exact(p: Problem) -> Sample:
    """Return a sample of the exact flow."""
    return ConstrainedFlow(
        p.base(), GaugeSquash(p.region(), validate_args=False)
    ).rsample_and_log_prob()


def radial_full_jacobian(p: Problem) -> Sample:
    """Return a sample of a radial squash, its determinant by automatic differentiation."""
    base, region = p.base(), p.region()

    count = len(p.balls)

    def one(latent: Tensor, centre: Tensor, *fields: tuple[Tensor, Tensor]) -> Tensor:
        balls = [Ball(*each, validate_args=False) for each in fields[:count]]
        boxes = [Box(*each, validate_args=False) for each in fields[count:]]
        sets = (region.bounds, *balls, *boxes)
        return RadialSquash(Region(sets, centre, validate_args=False))(latent)

    latent = base.rsample()
    jacobian = vmap(jacrev(one))(latent, p.centre, *p.balls, *p.boxes)
    log_det = torch.linalg.slogdet(jacobian)[1]
    return RadialSquash(region)(latent), base.log_prob(latent) - log_det


def dykstra(p: Problem, iterations: int = 50) -> Sample:
    """Return the tanh-squashed sample projected onto the intersection; it has no density."""
    action = tanh_normal(p)[0]
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
    constraints += [each for low, high in sides for each in (action >= low, action <= high)]
    program = cvxpy.Problem(cvxpy.Minimize(cvxpy.sum_squares(action - wish)), constraints)
    flat = [side for pair in sides for side in pair]
    layer = CvxpyLayer(program, parameters=[wish, *centers, *radii, *flat], variables=[action])
    values = [m for m, _ in p.balls] + [r for _, r in p.balls]
    values += [side for pair in p.boxes for side in pair]
    return lambda: (layer(tanh_normal(p)[0], *values)[0],)


def milliseconds(call: Callable[[], Any], seconds: float) -> float:
    """Return the median time of a call."""
    call()
    timer = Timer("call()", globals={"call": call}, num_threads=1)
    return timer.blocked_autorange(min_run_time=seconds).median * 1e3


def measure(batch: int, dim: int, constraints: int, *, quick: bool) -> dict[str, Any]:
    """Return forward and forward-plus-backward times of each method on one problem."""
    p = Problem.random(batch, dim, constraints)
    calls: dict[str, Callable[[], Sample]] = {
        "TanhNormal": lambda: tanh_normal(p),
        "exact": lambda: exact(p),
        "Dykstra, 50 rounds": lambda: dykstra(p),
    }
    if batch * dim <= 4096:
        calls["radial, full Jacobian"] = lambda: radial_full_jacobian(p)
    if not quick:
        compiled, compiled_tanh = torch.compile(exact), torch.compile(tanh_normal)
        calls["exact, compiled"] = lambda: compiled(p)
        calls["TanhNormal, compiled"] = lambda: compiled_tanh(p)
        if find_spec("cvxpylayers") and batch <= 256:
            calls["cvxpylayers"] = cvxpy_projection(p)
    seconds = 0.02 if quick else 0.5
    row: dict[str, Any] = {"batch": batch, "dim": dim, "constraints": constraints}
    for name, call in calls.items():

        def both(call: Callable[[], Sample] = call) -> None:
            torch.stack([part.sum() for part in call()]).sum().backward()

        row[name] = {"sample": milliseconds(call, seconds), "backward": milliseconds(both, seconds)}
        torch.compiler.reset()
    return row


def table(rows: list[dict[str, Any]], part: str) -> str:
    """Return ratios to TanhNormal, the compiled flow's to the compiled TanhNormal, as Markdown."""
    methods = dict.fromkeys(n for row in rows for n in row if isinstance(row[n], dict))
    names = [n for n in methods if not n.startswith("TanhNormal")]
    lines = [
        "| batch | d | K | TanhNormal, ms | " + " | ".join(names) + " |",
        "|" + "---|" * (4 + len(names)),
    ]
    for row in rows:
        cells = []
        for name in names:
            against = "TanhNormal, compiled" if name.endswith("compiled") else "TanhNormal"
            ratio = row[name][part] / row[against][part] if name in row else None
            cells.append("" if ratio is None else f"{ratio:.2f}" if ratio < 100 else f"{ratio:.0f}")
        head = [str(row[key]) for key in ("batch", "dim", "constraints")]
        cells = [*head, f"{row['TanhNormal'][part]:.3f}", *cells]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Measure and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="one small problem, for a test")
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
                rows.append(measure(batch, dim, constraints, quick=arguments.quick))
                print(json.dumps(rows[-1]), flush=True)
    versions = {
        name: _version(name) for name in ("cnfp_torchrl", "torch", "torchrl", "cvxpylayers")
    }
    about = {"python": platform.python_version(), "processor": platform.machine(), **versions}
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
            "Compiled flows are compared with the compiled TanhNormal.",
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


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


if __name__ == "__main__":
    main()
