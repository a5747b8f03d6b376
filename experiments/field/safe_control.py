"""Train controllers of a unicycle through layers that keep its barriers; keep each result.

    python -m experiments.field.safe_control LAYER SEED [--epochs 100] [--rate 1e-4] [--data FOLDER]
    python -m experiments.field.safe_control times [--data FOLDER]

LAYER is ``recession``, which is ours, ``hardnet_aff``, re-implemented from its paper (Min and
Azizan 2024, arXiv 2410.10807), or ``cbf_qp``, the allowed control closest to the nominal one,
which learns nothing. Network, starts, batches and learning rate are those published:
6-200-200-2, batches of 100, Adam with 1e-4. In a tenth of the published epochs no layer is done
learning at that rate; ``--rate`` gives another. ``times`` measures what a step of both takes, in
turns.

The aim: an objective of at most 500, no violation with zero tolerance, and no more time than
HardNet-Aff.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import torch
from torch import Tensor, nn

from cnfp_torchrl.geometry import Box, Region
from cnfp_torchrl.modules import ConstraintLayer
from cnfp_torchrl.tasks.safe_control import (
    Costs,
    Problem,
    barrier_excess,
    barrier_rows,
    encoded,
    episode,
    nominal_control,
    starts,
)
from cnfp_torchrl.tasks.safe_control.judge import barrier_values
from cnfp_torchrl.whole_file import whole_file, write_json
from experiments.field.jobs import DATA, SAFE_CONTROL
from experiments.field.records import about

LAYERS = ("recession", "hardnet_aff")
CBF_QP, TIMES = "cbf_qp", "times"
TURNS = 300
"""Turns of both layers whose times are taken."""
MOST, BATCH, LEARNING_RATE = 20_000.0, 100, 1e-4
EVERYWHERE = Box(*torch.tensor([[-torch.inf], [torch.inf]]).double().expand(2, 2))
TOLERANCE = 1e-4
"""The integrated excess from which HardNet counts a violation."""
TRAINED, TESTED = slice(0, 833), slice(916, None)
"""The starts of training and of the test, as published."""


def network() -> nn.Sequential:
    """Return the published network, in float64."""
    sizes = ((6, 200), (200, 200), (200, 2))
    first, second, last = (nn.Linear(*size, dtype=torch.float64) for size in sizes)
    for layer in (first, second, last):
        nn.init.kaiming_normal_(layer.weight)
    return nn.Sequential(first, nn.ReLU(), second, nn.ReLU(), last)


def correction(net: nn.Module, state: Tensor) -> Tensor:
    """Return the network's addition to the nominal control."""
    correction: Tensor = net(encoded(state))
    return correction


def hardnet_aff(problem: Problem, net: nn.Module, state: Tensor) -> Tensor:
    r"""Return :math:`u - A^+ \max(A u - b, 0)` of the wished control u, HardNet-Aff's map."""
    rows = barrier_rows(problem, state)
    wished = nominal_control(state) + correction(net, state)
    excess = ((rows.normals @ wished.unsqueeze(-1)).squeeze(-1) - rows.offsets).relu()
    return wished - torch.linalg.lstsq(rows.normals, excess.unsqueeze(-1)).solution.squeeze(-1)


def ours(layer: ConstraintLayer, problem: Problem, net: nn.Module, state: Tensor) -> Tensor:
    """Return what a layer makes of the wished control."""
    region = Region([EVERYWHERE, barrier_rows(problem, state)], validate_args=False)
    return layer(correction(net, state), region, nominal_control(state))


def cbf_qp(problem: Problem, state: Tensor) -> Tensor:
    """Return the allowed control closest to the nominal one, by looking at all that it can be.

    That is the nominal control itself, its closest point on one row's boundary, or both rows' own
    point.
    """
    rows, wished = barrier_rows(problem, state), nominal_control(state)
    excess = (rows.normals * wished.unsqueeze(-2)).sum(-1, keepdim=True) - rows.offsets[..., None]
    on_one = wished.unsqueeze(-2) - excess * rows.normals / rows.normals.square().sum(-1, True)
    on_both = torch.linalg.solve(rows.normals, rows.offsets)
    points = torch.cat([wished.unsqueeze(-2), on_one, on_both.unsqueeze(-2)], -2)
    # Rows are stricter than barriers by more than this.
    beyond = points @ rows.normals.mT - rows.offsets.unsqueeze(-2)
    allowed = (beyond <= 1e-12 * (1 + rows.offsets.abs().unsqueeze(-2))).all(-1)
    far = torch.linalg.vector_norm(points - wished.unsqueeze(-2), dim=-1)
    closest = far.masked_fill(~allowed, torch.inf).argmin(-1)
    return points[torch.arange(len(points)), closest]


def controller(name: str, problem: Problem, net: nn.Module) -> Callable[[Tensor], Tensor]:
    """Return the controller of a layer by its name."""
    if name == CBF_QP:
        return partial(cbf_qp, problem)
    if name == "hardnet_aff":
        return partial(hardnet_aff, problem, net)
    return partial(ours, ConstraintLayer(name), problem, net)


def train(name: str, seed: int, epochs: int, rate: float) -> dict[str, Any]:
    """Train, test, and return the record."""
    torch.manual_seed(seed)
    problem = Problem()
    states = starts(partial(barrier_values, problem))
    net = network()
    act = controller(name, problem, net)
    optimizer = torch.optim.Adam(net.parameters(), lr=rate)
    started, curve = time.perf_counter(), []
    for _ in range(epochs):
        costs = []
        for batch in states[TRAINED][torch.randperm(len(states[TRAINED]))].split(BATCH):
            cost = episode(problem, batch, act, most=MOST).cost
            optimizer.zero_grad()
            cost.mean().backward()
            optimizer.step()
            costs.append(float(cost.detach().mean()))
        curve.append(round(sum(costs) / len(costs), 3))
    seconds = time.perf_counter() - started
    with torch.no_grad():
        tested = episode(problem, states[TESTED], act, judge=partial(barrier_excess, problem))
    return {
        "layer": name,
        "seed": seed,
        "epochs": epochs,
        "rate": rate,
        "objective": float(tested.cost.mean()),
        "violations": tested.violations,
        "largest_excess": tested.largest,
        "excess": hardnet_measure(tested),
        "training_cost": curve,
        "seconds_an_epoch": seconds / max(epochs, 1),
        "about": about("cpu"),
    }


def hardnet_measure(tested: Costs) -> dict[str, float]:
    """Return HardNet's own measure of violations, as its table has it.

    Excesses are integrated over an episode. Largest and mean are over barriers, and the count is
    that of barriers beyond `TOLERANCE`; all are means over episodes.
    """
    assert tested.excess is not None
    return {
        "largest": float(tested.excess.amax(-1).mean()),
        "mean": float(tested.excess.mean()),
        "count": float((tested.excess > TOLERANCE).sum(-1).double().mean()),
    }


def times() -> dict[str, Any]:
    """Return what a batch takes through network and layer, and with the gradient.

    Both layers take turns; medians of the processor's milliseconds, and of ours over HardNet-Aff's
    in the same turn.
    """
    problem = Problem()
    states = starts(partial(barrier_values, problem))[:BATCH]
    net = network()
    acts = [controller(name, problem, net) for name in LAYERS]
    found: dict[str, Any] = {"states": BATCH, "turns": TURNS, "about": about("cpu")}
    for kind in ("forward", "backward"):
        taken = []
        for _ in range(TURNS):
            turn = []
            for act in acts:
                started = time.process_time()
                with torch.set_grad_enabled(kind == "backward"):
                    control = act(states)
                if kind == "backward":
                    control.square().sum().backward()
                turn.append(1e3 * (time.process_time() - started))
            taken.append(turn)
        medians = [round(median(column), 4) for column in zip(*taken, strict=True)]
        ratio = median(mine / theirs for mine, theirs in taken)
        found[kind] = {**dict(zip(LAYERS, medians, strict=True)), "ratio": round(ratio, 3)}
    return found


def main() -> None:
    """Do what the command line names, unless it has a record."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("layer", choices=(*LAYERS, CBF_QP, TIMES))
    parser.add_argument("seed", type=int, nargs="?", help="of network and batches")
    parser.add_argument("--epochs", type=int, default=100)
    parser.add_argument("--rate", type=float, default=LEARNING_RATE, help="learning rate")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the records")
    given = parser.parse_args()
    torch.set_num_threads(1)
    folder = given.data / SAFE_CONTROL
    if given.layer == TIMES:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / f"{TIMES}.json", times())
        return
    if given.layer == CBF_QP:
        given.seed, given.epochs = 0, 0
    if given.seed is None:
        sys.exit(f"SEED: expected a number after {given.layer}")
    path = folder / given.layer / f"{given.epochs}_epochs_{given.rate:g}_rate_{given.seed}.json"
    if path.exists():
        return
    record = train(given.layer, given.seed, given.epochs, given.rate)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path, exclusive=True) as file:
        file.write(f"{json.dumps(record)}\n".encode())
    print({name: value for name, value in record.items() if name not in ("training_cost", "about")})


if __name__ == "__main__":
    main()
