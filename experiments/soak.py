"""Take ten million steps through a collector; count violations, watch the memory, keep the result.

    python experiments/soak.py [--steps 10000000] [--agents 4096] [--flow exact] [--seed 0]

The environment and its constraints are those of the default configuration, the actor is untrained,
and all steps go through the collector, the counts and a replay buffer as in training, which is full
after a hundredth of them. The environment counts violations by its own indicators with zero
tolerance. The command fails when there is one, or when the memory grows.
"""

from __future__ import annotations

import argparse
import platform
import sys
import time
from importlib.metadata import version
from pathlib import Path

import psutil
import torch
from hydra.utils import instantiate
from tqdm import tqdm

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.keys import CONSTRAINT_STATES
from cnfp_torchrl.text_table import markdown_table
from cnfp_torchrl.training.agent import build_actor, build_environment
from cnfp_torchrl.training.constraint_counts import ConstraintTally
from cnfp_torchrl.training.storage import prepare_buffer
from cnfp_torchrl.whole_file import whole_file

RESULT = Path(__file__).parent / "results" / "soak.md"

PARTS = 20
"""Number of measurements."""

GROWTH = 0.02
"""Share by which the memory may grow from the first half's highest measurement to the last one.

The first part, in which the buffer fills and libraries allocate what they keep, does not count.
"""


def main() -> None:
    """Take the steps, write `RESULT`, and fail where something is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--steps", type=int, default=10_000_000)
    parser.add_argument("--agents", type=int, default=4096)
    parser.add_argument("--flow", default="exact")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    overrides = [
        f"env.agents={options.agents}",
        f"collector.total_frames={options.steps}",
        f"replay_buffer.storage.max_size={max(options.steps // 100, options.agents)}",
        f"flow={options.flow}",
    ]
    config = compose_config(*overrides)
    torch.manual_seed(options.seed)
    torch.set_num_threads(config.threads)
    env = build_environment(config)
    env.set_seed(options.seed)
    actor = build_actor(config, env)
    collector = instantiate(config.collector, _partial_=True)(env, actor)
    buffer = instantiate(config.replay_buffer)
    stored = prepare_buffer(
        buffer, env, actor.in_keys, constraint_bytes=config.training.constraint_bytes
    )
    tally = ConstraintTally.of(env)
    process = psutil.Process()
    started = time.perf_counter(), time.process_time()
    rows: list[tuple[int, float, float]] = []
    steps = 0
    for collected in tqdm(collector, total=options.steps // options.agents, mininterval=10):
        batch = collected.reshape(-1)
        tally.add(batch)
        buffer.extend(batch.select(*stored))
        buffer.sample()
        steps += len(batch)
        if steps >= options.steps * (len(rows) + 1) / PARTS:
            seconds = time.process_time() - started[1]
            rows.append((steps, process.memory_info().rss / 2**20, seconds))
    collector.shutdown()
    counts = tally.counts()
    violations = {name: count.violations for name, count in counts.items()}
    settled = [row[1] for row in rows[1 : PARTS // 2]]
    growth = rows[-1][1] / max(settled) - 1
    packages = ", ".join(f"{name} {version(name)}" for name in ("torch", "torchrl", "tensordict"))
    given = " ".join(f"--{name} {value}" for name, value in vars(options).items())
    wall, processor = time.perf_counter() - started[0], time.process_time() - started[1]
    states = [["constraint", "violations", *(f"steps: {name}" for name in CONSTRAINT_STATES)]]
    for name, count in counts.items():
        steps_in = [f"{count.steps.get(state, 0):,}" for state in CONSTRAINT_STATES]
        states.append([name, str(count.violations), *steps_in])
    memory = [["steps", "resident memory, MiB", "processor, s"]]
    memory += [[f"{n:,}", f"{rss:.1f}", f"{seconds:.0f}"] for n, rss, seconds in rows]
    text = (
        f"# {steps:,} steps\n\n`python experiments/soak.py {given}`\n\n"
        f"python {platform.python_version()}, {packages}\n\n"
        f"{steps:,} steps through the collector in {wall:.0f} s ({processor:.0f} s of one "
        f"processor, {steps / processor:,.0f} steps a second). Violations: {violations}. Memory: "
        f"{growth:+.2%} from the highest of the first half to the end.\n\n"
        f"{markdown_table(states)}\n\n{markdown_table(memory)}\n"
    )
    with whole_file(RESULT) as file:
        file.write(text.encode())
    sys.stdout.write(text)
    if any(violations.values()):
        sys.exit(f"expected no violation, counted {violations}")
    if growth > GROWTH:
        sys.exit(f"expected flat memory, but it grew by {growth:.1%}")


if __name__ == "__main__":
    main()
