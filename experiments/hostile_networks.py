"""Put hostile networks behind every flow, count the violations, and keep the result.

    python experiments/hostile_networks.py [--steps 1000000] [--agents 2000] [--seed 0]

The environment, its constraints and the untrained network are those of the default configuration.
The environment counts violations by its own indicators, with zero tolerance, on the float32 action
that it executes. Every count of a safe flow must be 0: the command fails otherwise. The paper's
chain and no flow at all are there to compare with.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import platform
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from torch import Tensor, nn
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.envs import constraint_bijectors, constraint_names
from cnfp_torchrl.modules import flow_head, make_constrained_actor
from cnfp_torchrl.text_table import markdown_table
from cnfp_torchrl.training.agent import build_actor, build_environment

RESULT = Path(__file__).parent / "results" / "hostile_networks.json"
SAFE_FLOWS = ("exact", "gauge", "radial", "projection")
FLOWS = (*SAFE_FLOWS, "squash", "unconstrained")
HUGE = 1e6

Mean = Callable[[Tensor], Tensor]
"""From observations ``(*batch, 5)`` to latent means ``(*batch, 2)``; may draw random numbers."""


def zero(observation: Tensor) -> Tensor:
    """Return 0."""
    return torch.zeros_like(observation[..., :2])


def corners(observation: Tensor) -> Tensor:
    """Draw -1e6 or +1e6 for each component: pressed into a corner of the action bounds."""
    return HUGE * (2.0 * torch.randint(0, 2, observation[..., :2].shape) - 1)


def axes(observation: Tensor) -> Tensor:
    """Draw -1e6, 0 or +1e6 for each component: also straight against walls, and no motion."""
    return HUGE * torch.randint(-1, 2, observation[..., :2].shape).float()


def all_magnitudes(observation: Tensor) -> Tensor:
    """Draw a sign and a magnitude, log-uniformly from 1e-8 to 1e6, for each component."""
    shape = observation[..., :2].shape
    return (2.0 * torch.randint(0, 2, shape) - 1) * 10 ** (14 * torch.rand(shape) - 8)


def to_the_middle(observation: Tensor) -> Tensor:
    """Push towards the middle of the rectangle."""
    return -HUGE * observation[..., :2]


def from_stations(observation: Tensor) -> Tensor:
    """Push away from the nearest station; all stations lie on the axes, near the walls."""
    position = observation[..., :2]
    far = torch.zeros_like(position).scatter(-1, position.abs().argmax(-1, keepdim=True), 1.0)
    return -HUGE * far * position.sign()


@dataclass(frozen=True)
class Hostile:
    """A network that ignores learning and aims for trouble.

    Args:
        mean: The latent mean.
        scale: The latent scale.
        redrawn: ``step`` if the mean is evaluated at every step, ``episode`` if it is kept.
    """

    mean: Mean
    scale: float
    redrawn: str


NETWORKS: dict[str, Hostile | None] = {
    "untrained, default": None,
    "0, scale 1e-8": Hostile(zero, 1e-8, "step"),
    "0, scale 1e4": Hostile(zero, 1e4, "step"),
    "+-1e6 per episode, scale 1e-8": Hostile(corners, 1e-8, "episode"),
    "+-1e6 per episode, scale 1e4": Hostile(corners, 1e4, "episode"),
    "+-1e6 per step, scale 1e-8": Hostile(corners, 1e-8, "step"),
    "+-1e6 per step, scale 1e4": Hostile(corners, 1e4, "step"),
    "+-1e6 or 0 per episode, scale 1e-8": Hostile(axes, 1e-8, "episode"),
    "+-1e-8 to +-1e6 per episode, scale 1e-8": Hostile(all_magnitudes, 1e-8, "episode"),
    "+-1e-8 to +-1e6 per step, scale 1e-8": Hostile(all_magnitudes, 1e-8, "step"),
    "1e6 towards the rectangle, scale 1e-8": Hostile(to_the_middle, 1e-8, "step"),
    "1e6 away from the station, scale 1e-8": Hostile(from_stations, 1e-8, "step"),
}
"""By name; None stands for the network of the default configuration."""


class HostileNetwork(nn.Module):
    """The latent Gaussian of a `Hostile`, as a network."""

    def __init__(self, hostile: Hostile) -> None:
        super().__init__()
        self.hostile = hostile
        self.mean: Tensor | None = None

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return location and scale."""
        if self.mean is None or self.hostile.redrawn == "step":
            self.mean = self.hostile.mean(observation)
        return self.mean, torch.full_like(self.mean, self.hostile.scale)

    def new_episode(self) -> None:
        """Let the next call draw a new mean."""
        self.mean = None


@dataclass(frozen=True)
class Row:
    """What one network did behind one flow.

    Args:
        flow: The name of the flow's configuration.
        network: The name of the network.
        steps: The environment steps.
        violations: The violations by constraint, as the environment counts them.
        drops: States in which a constraint was inactive, by constraint.
        minimum_anchor_slack: The least slack of an anchor over all states, in action units.
        seconds: How long it took.
    """

    flow: str
    network: str
    steps: int
    violations: dict[str, int]
    drops: dict[str, int]
    minimum_anchor_slack: float
    seconds: float


@torch.no_grad()
def run(
    flow: str, name: str, hostile: Hostile | None, *, steps: int, agents: int, seed: int
) -> Row:
    """Run one network behind one flow, in whole episodes of all agents."""
    started = time.perf_counter()
    torch.manual_seed(seed)
    config = default_config(flow)
    env = build_environment(config, batch_size=[agents], with_anchor=True)
    env.set_seed(seed)
    actor, new_episode = build(config, env, hostile)
    head = flow_head(actor)
    names = constraint_names(env)
    costs, least, drops = torch.zeros(len(names)), torch.inf, dict.fromkeys(head.order, 0)
    taken, state = 0, env.reset()
    with set_exploration_type(ExplorationType.RANDOM):
        while taken < steps:
            transition, state = env.step_and_maybe_reset(actor(state))
            region = head.get_region(transition)
            least = min(least, float(region.slack(region.anchor).min()))
            for bijector in head.bijectors:
                drops[bijector.name] += int((~transition.get(bijector.active_key)).sum())
            costs += transition.get(("next", "cost")).sum(0)
            taken += agents
            if bool(transition.get(("next", "done")).any()):
                new_episode()
    violations = dict(zip(names, costs.long().tolist(), strict=True))
    return Row(flow, name, taken, violations, drops, least, time.perf_counter() - started)


@functools.cache
def default_config(flow: str) -> DictConfig:
    """Return the default configuration of training with a flow."""
    return compose_config(f"flow={flow}")


def build(
    config: DictConfig, env: TransformedEnv, hostile: Hostile | None
) -> tuple[SafeProbabilisticTensorDictSequential, Callable[[], None]]:
    """Return the actor, and what to call before a new episode."""
    if hostile is None:
        return build_actor(config, env), lambda: None
    network = HostileNetwork(hostile)
    actor = make_constrained_actor(
        network,
        bijectors=constraint_bijectors(env),
        spec=env.action_spec_unbatched,
        flow=instantiate(config.flow),
    )
    return actor, network.new_episode


def run_all(*, steps: int, agents: int, seed: int) -> Iterator[Row]:
    """Run every network behind every flow."""
    for flow in FLOWS:
        for name, hostile in NETWORKS.items():
            yield run(flow, name, hostile, steps=steps, agents=agents, seed=seed)


def as_markdown(result: dict[str, Any]) -> str:
    """Return the result as a table."""
    names = list(result["rows"][0]["violations"])
    columns = ["flow", "network: latent mean and scale", "steps"]
    columns += [f"violations: {name}" for name in names]
    columns += ["constraints dropped", "least slack of the anchor"]
    rows = [columns]
    for row in result["rows"]:
        counts = [f"{row['violations'][name]:,}" for name in names]
        dropped = f"{sum(row['drops'].values()):,}"
        cells = [row["flow"], row["network"], f"{row['steps']:,}", *counts, dropped]
        rows.append([*cells, f"{row['minimum_anchor_slack']:.5f}"])
    versions = ", ".join(f"{name} {number}" for name, number in result["versions"].items())
    return (
        f"# Violations of hostile networks\n\n`{result['command']}`\n\n{versions}\n\n"
        "Means are those of the latent Gaussian; +- stands for a sign drawn for each component. "
        "Slack is in action units.\n\n"
        f"{markdown_table(rows)}\n"
    )


def main() -> None:
    """Run everything, write the JSON file and the Markdown file beside it, and judge."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=1_000_000, help="of each network and flow")
    parser.add_argument("--agents", type=int, default=2000, help="that act in parallel")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=RESULT, help="the JSON file to write")
    arguments = parser.parse_args()

    rows = []
    options = {"steps": arguments.steps, "agents": arguments.agents, "seed": arguments.seed}
    for row in run_all(**options):
        rows.append(row)
        sys.stdout.write(f"{row}\n")
        sys.stdout.flush()
    packages = ("cnfp_torchrl", "torch", "torchrl", "tensordict")
    flags = " ".join(f"--{name} {value}" for name, value in options.items())
    result = {
        "command": f"python experiments/hostile_networks.py {flags}",
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in packages},
        },
        "rows": [dataclasses.asdict(row) for row in rows],
    }
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps(result, indent=2) + "\n")
    arguments.output.with_suffix(".md").write_text(as_markdown(result))
    safe = [row for row in rows if row.flow in SAFE_FLOWS]
    broken = [row for row in safe if any(row.violations.values())]
    if broken:
        sys.exit(f"violations, of which there should be none: {broken}")


if __name__ == "__main__":
    main()
