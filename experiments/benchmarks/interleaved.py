"""Times of calls that take turns, and their ratios to one of them."""

from __future__ import annotations

import json
import os
import platform
import sys
import time
from collections.abc import Callable, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median, quantiles
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from cnfp_torchrl.text_table import markdown_table

ROUNDS = 7
Call = Callable[[], object]
Rows = dict[str, dict[str, float]]


def wait(device: torch.device | None = None) -> None:
    """Wait until a GPU has done all that it was asked to."""
    if device is not None and device.type == "cuda":
        torch.cuda.synchronize(device)


def rounds(
    calls: Mapping[str, Call],
    count: int = ROUNDS,
    seconds: float = 0.1,
    device: torch.device | None = None,
) -> dict[str, list[float]]:
    """Return the seconds of a call of each kind in each round.

    In a round all take their turn, so that another program's load falls on all of them. Without a
    GPU the process's own time on the processor counts, which waiting for one does not prolong.

    Args:
        calls: Calls by name.
        count: The number of rounds.
        seconds: The time that a call is repeated for in a round.
        device: The device whose work is waited for.
    """
    clock = time.perf_counter if device is not None and device.type == "cuda" else time.process_time
    repeats = {}
    for name, call in calls.items():
        for _ in range(3):
            call()
        wait(device)
        started = clock()
        call()
        wait(device)
        once = clock() - started
        repeats[name] = max(1, min(1000, round(seconds / once)))
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(count):
        for name, call in calls.items():
            wait(device)
            started = clock()
            for _ in range(repeats[name]):
                call()
            wait(device)
            times[name].append((clock() - started) / repeats[name])
    return times


def compared(times: Mapping[str, list[float]], reference: str, work: int = 0) -> Rows:
    """Return medians in milliseconds, and ratios within a round to a reference with quartiles.

    Args:
        times: Seconds of each kind in each round.
        reference: The kind that the others are compared with.
        work: The number of things that a call does, for a column of how many a second; 0 leaves it
            out.
    """
    rows: Rows = {}
    for name, values in times.items():
        ratios = [a / b for a, b in zip(values, times[reference], strict=True)]
        low, middle, high = quantiles(ratios, n=4, method="inclusive")
        row = {"ms": median(values) * 1e3}
        if work:
            row["per second"] = work / median(values)
        rows[name] = {**row, "ratio": middle, "low": low, "high": high}
    return rows


class Replay:
    """Steps of one environment by the actions that a constrained actor took in another.

    Both begin in the same states, again and again, so that both go through the same ones.

    Args:
        env: The environment to step, plain or constrained.
        recorded: The rollout of the constrained actor, ``(*batch, steps)``.
        start: Arguments of a reset to where the rollout began.
    """

    def __init__(self, env: EnvBase, recorded: TensorDictBase, start: Mapping[str, Any]) -> None:
        self.env, self.start, self.time = env, start, 0
        self.actions = recorded["action"].unbind(-2)
        self.state = env.reset(**start)

    def __call__(self) -> None:
        """Take one step."""
        action = self.actions[self.time]
        self.state = self.env.step_mdp(self.env.step(self.state.set("action", action)))
        self.time = (self.time + 1) % len(self.actions)
        if self.time == 0:
            self.state = self.env.reset(**self.start)


def point_nav_start(recorded: TensorDictBase) -> dict[str, Any]:
    """Return the arguments of point navigation's reset to where a rollout began."""
    x, y, battery, *goal = recorded["observation"].select(-2, 0).unbind(-1)
    charge = (100 * battery).round().long()
    return {
        "position": torch.stack([x, y], -1),
        "battery": charge,
        "goal": torch.stack(goal, -1),
    }


def versions(*packages: str) -> dict[str, str]:
    """Return the versions of this library and of what it stands on, and of further packages."""
    known = {"python": platform.python_version()}
    for package in ("cnfp_torchrl", "torch", "torchrl", "tensordict", *packages):
        try:
            known[package] = version(package)
        except PackageNotFoundError:
            found = getattr(sys.modules.get(package), "__version__", "not installed")
            known[package] = str(found)
    return known


def processor() -> str:
    """Return the processor, its cores and the threads that torch uses."""
    threads = torch.get_num_threads()
    return f"{platform.machine()}, {os.cpu_count()} cores, {threads} thread(s)"


def table(title: str, rows: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Return rows as the lines of a Markdown table."""
    columns = list(dict.fromkeys(column for row in rows.values() for column in row))
    cells = [
        [name, *(_number(row[column]) if column in row else "" for column in columns)]
        for name, row in rows.items()
    ]
    return [f"## {title}", "", markdown_table([["", *columns], *cells]), ""]


def _number(value: float) -> str:
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:,.0f}" if value >= 100 else f"{value:.2f}" if value >= 1 else f"{value:.3f}"


def write(
    path: Path, title: str, about: Mapping[str, Any], results: Mapping[str, Rows], *notes: str
) -> None:
    """Write results to a JSON file, and as Markdown beside it.

    Args:
        path: The JSON file.
        title: The title of the page.
        about: What the numbers depend on.
        results: Tables by title.
        notes: Sentences below the first ones.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"about": about, "results": results}, indent=1) + "\n")
    lines = [f"# {title}", "", *(f"- {key}: {value}" for key, value in about.items()), ""]
    rule = (
        "Medians over rounds in which all take turns; ratios of time to the first row of a table, "
    )
    lines += [" ".join([f"{rule}taken within a round, with quartiles.", *notes]), ""]
    for title, rows in results.items():
        lines += table(title, rows)
    path.with_suffix(".md").write_text("\n".join(lines))
