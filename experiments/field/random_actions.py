"""Act at random in all of the field's tasks, with hostile latents, and count; keep the result.

    python -m experiments.field.random_actions [--steps 50000] [--agents 250] [--seed 0]
        [--tasks ...] [--data FOLDER]

A file for each task is written as soon as the task is done. What has its file already is not done
again, so the same command goes on where it was stopped.

The exact flow maps latents of a random direction and of magnitudes from 1e-2 to 1e6, log-uniform,
to float32 actions. The judges read the simulator's own state, in float64, with zero tolerance.
Coverage is told of actions drawn uniformly from the action bounds and then moved towards the
anchor by a random share: how many of those that the judges allow lie in the sets.
The command fails if an allowed action was none.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

from cnfp_torchrl.keys import active_key
from cnfp_torchrl.modules import flow_head
from cnfp_torchrl.tasks.robots import RobotEnv
from cnfp_torchrl.training.agent import build_actor, build_environment
from cnfp_torchrl.whole_file import write_json
from experiments.field.jobs import ACTION_SIZES, DATA, RANDOM_ACTIONS, Job
from experiments.field.records import RecordError, about

SMALLEST, LARGEST = -2.0, 6.0
"""Decimal logarithms of the latents' magnitudes."""
DRAWN, EVERY = 8, 20
"""Actions drawn from the bounds for coverage in a state, and the steps between two such states."""


@dataclass(frozen=True)
class Settings:
    """What a task is acted in with.

    Args:
        steps: The least number of steps, of all agents together.
        agents: The number of agents that act in parallel.
        seed: The seed of everything random.
    """

    steps: int
    agents: int
    seed: int


def result_of(task: str, settings: Settings, data: Path) -> dict[str, Any]:
    """Return the kept result of a task, or act in it and keep what comes out.

    Raises:
        RecordError: for a kept result of other settings.
    """
    path = data / RANDOM_ACTIONS / f"{task}.json"
    if path.exists():
        kept: dict[str, Any] = json.loads(path.read_bytes())
        if kept["settings"] != asdict(settings):
            raise RecordError(
                f"{path}: expected a result of {asdict(settings)}, found one of "
                f"{kept['settings']}; give those, or another folder with --data"
            )
        return kept
    done = act(task, settings)
    result = {"settings": asdict(settings), "about": about("cpu"), **done}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, result)
    return result


@torch.no_grad()
def act(task: str, settings: Settings) -> dict[str, Any]:
    """Act in one task; return counts."""
    steps, agents, seed = settings.steps, settings.agents, settings.seed
    started = time.perf_counter()
    torch.manual_seed(seed)
    config = Job(task, "hard", seed).config()
    env = build_environment(config, batch_size=[agents])
    env.set_seed(seed)
    head = flow_head(build_actor(config, env))
    robots = env.base_env
    assert isinstance(robots, RobotEnv)
    violations = torch.zeros(len(robots.judges))
    relaxed = dict.fromkeys(head.order, 0)
    allowed = covered = unsound = taken = 0
    state = env.reset()
    while taken < steps:
        if taken // agents % EVERY == 0:
            counts = coverage(robots, head, state)
            allowed, covered, unsound = (
                a + b for a, b in zip((allowed, covered, unsound), counts, strict=True)
            )
        direction = torch.nn.functional.normalize(torch.randn(agents, head.action_dim), dim=-1)
        size = SMALLEST + (LARGEST - SMALLEST) * torch.rand(agents, 1)
        state["action"] = head.get_bijector(state)(direction * 10**size)
        for name in relaxed:
            relaxed[name] += int((~state[active_key(name)]).sum())
        transition, state = env.step_and_maybe_reset(state)
        violations += transition["next", "cost"].sum(0)
        taken += agents
    return {
        "task": task,
        "steps": taken,
        "violations": dict(zip(robots.judges, violations.long().tolist(), strict=True)),
        "relaxed": {name: count / taken for name, count in relaxed.items()},
        "drawn_and_allowed": allowed,
        "coverage": covered / allowed if allowed else None,
        "unsound": unsound,
        "seconds": round(time.perf_counter() - started, 1),
    }


def coverage(robots: RobotEnv, head: Any, state: TensorDictBase) -> tuple[int, int, int]:
    """Return how many of the drawn actions the judges allow, the sets too, and the sets alone."""
    bounds, region = head.bounds, head.get_region(state)
    shape = (DRAWN, len(robots.robots))
    drawn = bounds.low + (bounds.high - bounds.low) * torch.rand(*shape, head.action_dim)
    # Sets that are small beside the bounds are hit, too, on both sides of their boundaries.
    drawn = torch.lerp(region.anchor, drawn, 10 ** -(1.5 * torch.rand(*shape, 1)))
    inside = region.contains(drawn).numpy()
    judged = np.array(
        [
            [
                not any(
                    judge(robot.unwrapped.model, robot.unwrapped.data, action)  # type: ignore[attr-defined]
                    for judge in robots.judges.values()
                )
                for robot, action in zip(robots.robots, row, strict=True)
            ]
            for row in drawn.double().numpy()
        ]
    )
    return int(judged.sum()), int((judged & inside).sum()), int((inside & ~judged).sum())


def main() -> None:
    """Act in all tasks, write the result, and judge."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=50_000, help="of each task")
    parser.add_argument("--agents", type=int, default=250, help="that act in parallel")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tasks", nargs="+", choices=list(ACTION_SIZES), default=ACTION_SIZES)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the records")
    given = parser.parse_args()
    torch.set_num_threads(1)
    settings = Settings(given.steps, given.agents, given.seed)
    bad = []
    for task in given.tasks:
        row = result_of(task, settings, given.data)
        print(row, flush=True)
        if any(row["violations"].values()) or row["unsound"]:
            bad.append(row)
    if bad:
        sys.exit(f"violations, of which there should be none: {bad}")


if __name__ == "__main__":
    main()
