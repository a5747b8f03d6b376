"""One small file for each run: what was run, on what, and what came out of it."""

from __future__ import annotations

import dataclasses
import json
import os
import platform
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from cnfp_torchrl.installed_versions import installed_versions
from cnfp_torchrl.whole_file import whole_file
from experiments.checkout import commit

PACKAGES = ("torch", "torchrl", "tensordict", "gymnasium", "mujoco", "stable_baselines3", "numpy")


class RecordError(ValueError):
    """A file is not what it should be."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a trained policy did in whole episodes.

    Args:
        returns: The undiscounted return of each episode.
        steps: The number of environment steps in all.
        violations: Violating steps by constraint, by the judges.
        moved: The share of actions that the constraints moved by more than 0.001 in a component.
    """

    returns: list[float]
    steps: int
    violations: dict[str, int]
    moved: float


@dataclass(frozen=True, kw_only=True)
class Record:
    """One finished run.

    Args:
        task: See `experiments.field.jobs.Job`.
        method: See `experiments.field.jobs.Job`.
        seed: See `experiments.field.jobs.Job`.
        overrides: What was given beside the shared settings.
        about: Versions, machine, commit, device and threads.
        steps: Environment steps of training.
        seconds: Wall time of training and evaluation; runs beside it slow it down.
        steps_per_second: Environment steps in a second of training after its warm-up.
        milliseconds: An action's, of a single state, from the observation on: sets, anchor where
            there is one, network and flow or projection.
        projections: Points projected in training, in acting and in learning.
        reward_steps: Ends of intervals, in environment steps since the start.
        rewards: Mean reward of a step in each interval.
        episode_steps: Ends of episodes, in environment steps since the start.
        episode_returns: The return of each of these episodes.
        violations: Violating steps of training by constraint, by the judges.
        relaxed: Share of training's steps in which the constraint gave way, by constraint.
        greedy: The outcome of the deterministic policy.
        stochastic: The outcome of drawn actions.
    """

    task: str
    method: str
    seed: int
    overrides: list[str]
    about: dict[str, Any]
    steps: int
    seconds: float
    steps_per_second: float
    milliseconds: float
    projections: int
    reward_steps: list[int]
    rewards: list[float]
    episode_steps: list[int]
    episode_returns: list[float]
    violations: dict[str, int]
    relaxed: dict[str, float]
    greedy: Outcome
    stochastic: Outcome

    def save(self, path: Path) -> None:
        """Write the record, complete or not at all.

        Raises:
            FileExistsError: when something stands there already.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path, exclusive=True) as file:
            file.write(f"{json.dumps(dataclasses.asdict(self), allow_nan=False)}\n".encode())

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file.

        Raises:
            RecordError: naming the file and what is missing or foreign in it.
        """
        try:
            content = json.loads(path.read_bytes())
            for name in ("greedy", "stochastic"):
                content[name] = Outcome(**content[name])
            return cls(**content)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise RecordError(f"{path}: {type(error).__name__}: {error}") from None

    @property
    def all_violations(self) -> int:
        """Violating steps in training and both evaluations, all constraints together."""
        counts = (self.violations, self.greedy.violations, self.stochastic.violations)
        return sum(sum(by_constraint.values()) for by_constraint in counts)


def read_records(data: Path) -> list[Record]:
    """Read all records of a folder, in the order of their paths.

    Raises:
        RecordError: for a file that is no record, or stands where it does not belong.
    """
    records = []
    for path in sorted(data.glob("*/*/seed_*.json")):
        record = Record.read(path)
        expected = data / record.task / record.method / f"seed_{record.seed}.json"
        if path != expected:
            raise RecordError(f"{path}: expected at {expected}, by what it says of itself")
        records.append(record)
    return records


def about(device: str) -> dict[str, Any]:
    """Return versions and the kind of machine."""
    return {
        "python": platform.python_version(),
        **installed_versions(PACKAGES),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "device": device,
        "threads": 1,
        "commit": commit(),
    }
