"""A sweep's runs, read from their folders: what was varied, and what came of it."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import yaml
from scipy import stats

from cnfp_torchrl.training.checkpoints import Checkpoints
from cnfp_torchrl.training.run_folder import CONFIG, STATES, RunFolder

OVERRIDES = Path(".hydra") / "overrides.yaml"
"""The file in a run's folder that says what was asked for."""

SEED = "seed"


@dataclass(frozen=True)
class SweepRun:
    """One run of a sweep.

    Args:
        path: The run's folder.
        given: What was asked for, as Hydra's overrides.
        state: Done, failed, running, stopped or not started.
        reason: The reason why it failed, or where it stopped.
        summary: The run's summary; empty where it is not done.
    """

    path: Path
    given: Sequence[str]
    state: str
    reason: str = ""
    summary: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def overrides(self) -> dict[str, str]:
        """What was asked for, by key."""
        parts = (override.partition("=") for override in self.given)
        return {key.lstrip("+~"): value for key, _, value in parts}

    @property
    def is_done(self) -> bool:
        """Tell whether the run has results."""
        return self.state == "done"

    @property
    def score(self) -> float | None:
        """The score, or the return where the task has no score; None before the run is done."""
        if not self.is_done:
            return None
        score = self.summary["score"]
        return float(self.summary["return_mean"] if score is None else score)

    @property
    def violations(self) -> int | None:
        """All violating steps; None before the run is done, and where nothing judges."""
        counts = [n for n in self.summary.get("violations", {}).values() if n is not None]
        return sum(counts) if counts else None

    @property
    def relaxation(self) -> float | None:
        """The largest amount by which a constraint was relaxed; None where nobody tells."""
        reports = self.summary.get("constraints", {}).values()
        return max((report["largest_relaxation"] for report in reports), default=None)

    @property
    def seconds(self) -> float | None:
        """The time that the run took; None before it is done."""
        return self.summary.get("seconds")


@dataclass(frozen=True)
class Mean:
    """A mean over seeds, with an interval.

    Args:
        value: The mean.
        half_width: Half the width of its 95 % interval by Student's t; None for a single seed.
    """

    value: float
    half_width: float | None

    @classmethod
    def of(cls, values: Sequence[float]) -> Mean:
        """Return the mean of some numbers, at least one."""
        count, mean = len(values), statistics.fmean(values)
        if count < 2:
            return cls(mean, None)
        error = statistics.stdev(values) / math.sqrt(count)
        return cls(mean, float(stats.t.ppf(0.975, count - 1)) * error)


def run_folders(folder: Path) -> set[Path]:
    """Return the folders of a sweep's runs that were begun; none for a folder that is not there."""
    found = {path.parent.parent for path in folder.glob(f"**/{OVERRIDES}")}
    configured = {path.parent for path in folder.glob(f"**/{CONFIG}")}
    return found | {path for path in configured if path.name != ".hydra"}


def read_sweep(folder: Path, planned: Mapping[Path, Sequence[str]] | None = None) -> list[SweepRun]:
    """Return the runs in a folder, in the order of their numbers.

    Args:
        folder: The sweep's folder.
        planned: The overrides of all runs that the sweep was to have, by the folders meant for
            them; those that no folder holds are not started.

    Raises:
        FileNotFoundError: when there is none.
    """
    found = run_folders(folder)
    if not found:
        raise FileNotFoundError(
            f"folder: expected that of a sweep, given {folder}, which holds no run; give the one "
            "under multirun/ that training printed when the sweep ended"
        )
    runs = [_read_run(path) for path in found]
    begun = [sorted(run.given) for run in runs]
    for path, given in (planned or {}).items():
        if path not in found and sorted(given) not in begun:
            runs.append(SweepRun(path, given, "not started"))
    return sorted(runs, key=lambda run: _number(run.path))


def varied(runs: Iterable[SweepRun]) -> list[str]:
    """Return the keys that were not asked for in the same way of all runs."""
    runs = list(runs)
    keys = dict.fromkeys(key for run in runs for key in run.overrides)
    return [key for key in keys if len({run.overrides.get(key) for run in runs}) > 1]


def over_seeds(runs: Sequence[SweepRun]) -> dict[tuple[str, ...], list[SweepRun]]:
    """Return the runs by what was varied but for the seed."""
    keys = [key for key in varied(runs) if key != SEED]
    groups: dict[tuple[str, ...], list[SweepRun]] = {}
    for run in runs:
        groups.setdefault(tuple(run.overrides.get(key, "") for key in keys), []).append(run)
    return groups


def _number(path: Path) -> tuple[float, str]:
    first = path.name.partition("_")[0]
    return (int(first) if first.isdigit() else math.inf, str(path))


def _read_run(path: Path) -> SweepRun:
    folder = RunFolder(path)
    given: list[str] = []
    if (path / OVERRIDES).is_file():
        given = list(map(str, yaml.safe_load((path / OVERRIDES).read_text(encoding="utf-8")) or []))
    if folder.is_held:
        return SweepRun(path, given, "running")
    if folder.is_complete:
        return SweepRun(path, given, "done", summary=folder.load_summary())
    if (reason := folder.load_failure()) is not None:
        return SweepRun(path, given, "failed", reason)
    steps = Checkpoints(path / STATES, keep=1).frames()
    return SweepRun(path, given, "stopped", f"at step {steps[-1] if steps else 0}")
