"""Train controllers of a unicycle through layers that keep its barriers; keep each result.

    python -m experiments.field.safe_control LAYER SEED [--epochs 100] [--data FOLDER]

LAYER is ``recession``, which is ours, or ``hardnet_aff``, re-implemented from its paper (Min and
Azizan 2024, arXiv 2410.10807). Network, starts, batches and learning rate are those
published: 6-200-200-2, batches of 100, Adam with 1e-4.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
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
from cnfp_torchrl.whole_file import whole_file
from experiments.field.jobs import DATA
from experiments.field.records import about

LAYERS = ("recession", "hardnet_aff")
MOST, BATCH, LEARNING_RATE = 20_000.0, 100, 1e-4
EVERYWHERE = Box(*torch.tensor([[-torch.inf], [torch.inf]]).double().expand(2, 2))
TOLERANCE = 1e-4
"""The integrated excess from which HardNet counts a violation."""
TRAINED, TESTED = slice(0, 833), slice(916, None)
"""The starts of training and of the test, as published."""


def network() -> nn.Sequential:
    """Return the published network."""
    layers = nn.Sequential(
        nn.Linear(6, 200), nn.ReLU(), nn.Linear(200, 200), nn.ReLU(), nn.Linear(200, 2)
    )
    for layer in layers:
        if isinstance(layer, nn.Linear):
            nn.init.kaiming_normal_(layer.weight)
    return layers


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


def controller(name: str, problem: Problem, net: nn.Module) -> Callable[[Tensor], Tensor]:
    """Return the controller of a layer by its name."""
    if name == "hardnet_aff":
        return partial(hardnet_aff, problem, net)
    return partial(ours, ConstraintLayer(name), problem, net)


def train(name: str, seed: int, epochs: int) -> dict[str, Any]:
    """Train, test, and return the record."""
    torch.manual_seed(seed)
    torch.set_default_dtype(torch.float64)
    problem = Problem()
    states = starts(partial(barrier_values, problem))
    net = network()
    act = controller(name, problem, net)
    optimizer = torch.optim.Adam(net.parameters(), lr=LEARNING_RATE)
    started, curve = time.perf_counter(), []
    for _ in range(epochs):
        costs = []
        for batch in states[TRAINED][torch.randperm(833)].split(BATCH):
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
        "objective": float(tested.cost.mean()),
        "violations": tested.violations,
        "largest_excess": tested.largest,
        "excess": hardnet_measure(tested),
        "training_cost": curve,
        "seconds_an_epoch": seconds / epochs,
        "milliseconds": milliseconds(problem, net, states[:BATCH]),
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


@torch.no_grad()
def milliseconds(problem: Problem, net: nn.Module, states: Tensor) -> dict[str, float]:
    """Return the median time of network and layer on a batch, all layers taking turns."""
    times: dict[str, list[float]] = {name: [] for name in LAYERS}
    acts = {name: controller(name, problem, net) for name in LAYERS}
    for _ in range(50):
        for name, act in acts.items():
            started = time.perf_counter()
            act(states)
            times[name].append(1e3 * (time.perf_counter() - started))
    return {name: sorted(each)[len(each) // 2] for name, each in times.items()}


def main() -> None:
    """Train what the command line names, unless it has a record."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("layer", choices=LAYERS)
    parser.add_argument("seed", type=int)
    parser.add_argument("--epochs", type=int, default=100)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the records")
    given = parser.parse_args()
    torch.set_num_threads(1)
    path = given.data / "safe_control" / given.layer / f"{given.epochs}_epochs_{given.seed}.json"
    if path.exists():
        return
    record = train(given.layer, given.seed, given.epochs)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path, exclusive=True) as file:
        file.write(f"{json.dumps(record)}\n".encode())
    print({k: v for k, v in record.items() if k not in ("training_cost", "about")})


if __name__ == "__main__":
    main()
