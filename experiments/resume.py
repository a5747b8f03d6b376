"""Kill training at random moments, go on, compare with a run that was not killed; keep the result.

    python experiments/resume.py [--kills 20] [--steps 2400] [--seed 0] [--cost-steps 40000]

A run is killed by SIGKILL, resumed, killed again, until it ends; then another is begun, until as
many kills are done. Weights, states of the optimizer, summary and every entry of the log but those
of the clock have to be the same, bit by bit: the command fails otherwise. Then a run of the default
configuration is trained, and the time that saving its states took is measured.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import random
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import psutil
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.text_table import markdown_table
from cnfp_torchrl.training.run_folder import STATES, SUMMARY, RunFolder
from cnfp_torchrl.training.run_state import RunState
from cnfp_torchrl.training.train import train
from cnfp_torchrl.whole_file import whole_file

RESULT = Path(__file__).parent / "results" / "resume.md"

OF_THE_CLOCK = ("train/seconds", "train/processor_seconds", "train/steps_per_second")
OF_THE_PROCESS = ("seconds", "command", "commit")
"""What a summary says of the process that wrote it, and not of the policy."""

SETTINGS = (
    "training.warmup_frames=400",
    "training.update_ratio=0.25",
    "+env.base.max_steps=25",
    "evaluation.episodes=16",
    "figures=none",
    "checkpoint.interval=400",
)


def differences(first: Path, second: Path) -> list[str]:
    """Return what differs between two finished runs, but for their times and commands."""
    runs = [_content(path) for path in (first, second)]
    return [name for name in runs[0] if not _equal(runs[0][name], runs[1][name])]


def _content(path: Path) -> dict[str, Any]:
    summary = json.loads((path / SUMMARY).read_text())
    scalars = path / "metrics" / "scalars"
    rows = {str(file.relative_to(scalars)): file for file in scalars.rglob("*.csv")}
    return {
        "checkpoint": RunFolder(path).load_checkpoint(),
        "summary": {name: value for name, value in summary.items() if name not in OF_THE_PROCESS},
        "CSV": {n: f.read_text() for n, f in rows.items() if n[: -len(".csv")] not in OF_THE_CLOCK},
        "TensorBoard": _events(path / "tensorboard"),
    }


def _events(path: Path) -> dict[str, list[tuple[int, float]]]:
    """Return the points in TensorBoard's files, in the order in which they were written."""
    points: dict[str, list[tuple[int, float]]] = {}
    # Their names end with time, process and number.
    numbered = [([int(n) for n in re.findall(r"\d+", f.name)], f) for f in path.glob("events.*")]
    for _, file in sorted(numbered):
        reader = EventAccumulator(str(file), purge_orphaned_data=False).Reload()
        for name in reader.Tags()["scalars"]:
            if name not in OF_THE_CLOCK:
                points.setdefault(name, []).extend((e.step, e.value) for e in reader.Scalars(name))
    return points


def _equal(first: Any, second: Any) -> bool:
    if isinstance(first, torch.Tensor):
        return torch.equal(first, second)
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(_equal(first[k], second[k]) for k in first)
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(map(_equal, first, second))
    return bool(first == second)


def killed_runs(root: Path, *, kills: int, steps: int, seed: int) -> Iterator[list[str]]:
    """Yield a row for each killed run that has ended: its kills, and what differs.

    Args:
        root: The folder of the runs.
        kills: The number of kills in all.
        steps: The length of each run.
        seed: The seed of the moments.
    """
    moments = random.Random(seed)
    before = _children_seconds()
    _is_killed(root / "whole", steps)
    duration = _children_seconds() - before
    number = 0
    while kills > 0:
        number += 1
        path, killed = root / f"killed{number}", []
        while _is_killed(path, steps, moments.uniform(0, duration) if kills else math.inf):
            kills -= 1
            states = [file.stem for file in (path / STATES).glob("state-*")]
            last = max((int(name.rpartition("-")[2]) for name in states), default=0)
            killed.append(str(last))
            if RunFolder(path).is_finished:
                break  # killed while it went away
            if not RunFolder(path).has_started:
                shutil.rmtree(path, ignore_errors=True)
        different = differences(root / "whole", path)
        yield [str(number), ", ".join(killed) or "-", ", ".join(different) or "nothing"]


def _is_killed(path: Path, steps: int, seconds: float = math.inf) -> bool:
    """Train or go on in a process of its own; kill it when it has taken a time of the processor.

    Not by the clock: on a busy machine every kill would come early.

    Args:
        path: The folder of the run.
        steps: The length of the run.
        seconds: The time of the processor, if the process has not ended before.
    """
    settings = [f"hydra.run.dir={path}", f"collector.total_frames={steps}", *SETTINGS]
    arguments = [f"resume={path}"] if RunFolder(path).has_started else settings
    process = subprocess.Popen(
        [sys.executable, "-m", "cnfp_torchrl.commands.train", *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    while process.poll() is None:
        with suppress(psutil.Error):
            times = psutil.Process(process.pid).cpu_times()
            if times.user + times.system >= seconds:
                process.kill()
                process.wait()
                return True
        time.sleep(0.02)
    if process.returncode != 0:
        raise RuntimeError(f"the run in {path} failed by itself: exit code {process.returncode}")
    return False


def _children_seconds() -> float:
    """Return the time of the processor that ended processes of this one have taken."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def cost(root: Path, steps: int) -> list[list[str]]:
    """Return the time of a run of the default configuration, and of saving its states."""
    config = compose_config(f"collector.total_frames={steps}", "evaluation.episodes=2")
    save, spent = RunState.save, [0.0, 0.0, 0.0]

    def timed(self: RunState, frames: int) -> None:
        started = time.perf_counter(), time.process_time()
        save(self, frames)
        spent[0] += 1
        spent[1] += time.perf_counter() - started[0]
        spent[2] += time.process_time() - started[1]

    RunState.save = timed  # type: ignore[method-assign]
    started = time.perf_counter(), time.process_time()
    train(config, RunFolder.create(root / "cost"))
    wall, processor = time.perf_counter() - started[0], time.process_time() - started[1]
    RunState.save = save  # type: ignore[method-assign]
    size = sum(file.stat().st_size for file in (root / "cost" / STATES).iterdir())
    return [
        ["time", "training", f"{spent[0]:.0f} states", "share"],
        ["wall clock", f"{wall:.1f} s", f"{spent[1]:.2f} s", f"{spent[1] / wall:.2%}"],
        ["processor", f"{processor:.1f} s", f"{spent[2]:.2f} s", f"{spent[2] / processor:.2%}"],
        ["on disk at the end", "", f"{size / 1e6:.1f} MB", ""],
    ]


def main() -> None:
    """Do it all, and write `RESULT`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--steps", type=int, default=2400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cost-steps", type=int, default=40_000)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = [["run", "steps of the last state at each kill", "differs from the whole run in"]]
        for row in killed_runs(
            Path(folder), kills=options.kills, steps=options.steps, seed=options.seed
        ):
            sys.stdout.write(f"run {row[0]}: killed at {row[1]}; differs in {row[2]}\n")
            sys.stdout.flush()
            rows.append(row)
        costs = cost(Path(folder), options.cost_steps)
    packages = ", ".join(f"{name} {version(name)}" for name in ("torch", "torchrl", "tensordict"))
    given = " ".join(f"--{name.replace('_', '-')} {value}" for name, value in vars(options).items())
    text = (
        f"# Killed runs that go on\n\n`python experiments/resume.py {given}`\n\n"
        f"python {platform.python_version()}, {packages}\n\n"
        f"{options.kills} kills by SIGKILL at moments drawn over the processor time of a run, its "
        f"start and evaluation included. A run takes {options.steps} steps and saves every 400. "
        "Compared are weights, optimizer, summary, CSV and TensorBoard, but for times.\n\n"
        f"{markdown_table(rows)}\n\n"
        f"## What states cost\n\nThe default configuration for {options.cost_steps} steps, a state "
        f"every 10,000.\n\n{markdown_table(costs)}\n"
    )
    with whole_file(RESULT) as file:
        file.write(text.encode())
    sys.stdout.write(text)
    if any(row[2] != "nothing" for row in rows[1:]):
        sys.exit("a run that was killed ended otherwise than the one that was not")


if __name__ == "__main__":
    main()
