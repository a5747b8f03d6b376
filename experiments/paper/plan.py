"""Which runs are to be done: methods, seeds and budget, checked before anything starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf import OmegaConf

from cnfp_torchrl.configuration import config_directory
from cnfp_torchrl.training.run_folder import SUMMARY, RunFolder
from experiments.paper.collect import PRESENTATION, settings
from experiments.paper.differences import differences
from experiments.paper.records import RecordError, load_record

RESERVED = ("experiment", "seed", "collector.total_frames", *PRESENTATION)
"""Overrides that the command's own options give, or that runs side by side must not."""


class PlanError(ValueError):
    """What was asked for makes no sense; one line for each reason."""


@dataclass(frozen=True)
class Job:
    """One run to do.

    Args:
        method: of `known_methods`.
        seed: of everything random.
        steps: environment steps of training.
        overrides: further ones.
    """

    method: str
    seed: int
    steps: int
    overrides: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.method}, seed {self.seed}"

    @property
    def arguments(self) -> list[str]:
        """Overrides for the trainer."""
        return [
            f"experiment={self.method}",
            f"seed={self.seed}",
            f"collector.total_frames={self.steps}",
            *self.overrides,
            "logger=csv",
            "figures=none",
        ]

    def settings(self) -> dict[str, Any]:
        """Return the configuration that the run's record must have."""
        with initialize_config_dir(str(config_directory()), version_base="1.3"):
            content = OmegaConf.to_container(compose("train", self.arguments), resolve=True)
        assert isinstance(content, dict)
        return settings({str(name): each for name, each in content.items()})


def known_methods() -> list[str]:
    """Return the names of all experiments."""
    return sorted(path.stem for path in (config_directory() / "experiment").glob("*.yaml"))


def make_jobs(
    methods: Sequence[str], seeds: Sequence[int], steps: int, overrides: Sequence[str] = ()
) -> list[Job]:
    """Return the jobs, each seed of all methods before the next seed.

    Raises:
        PlanError: for unknown methods, repetitions, a bad budget, overrides that do not compose or
            that belong to an option.
    """
    reasons = []
    known = known_methods()
    if unknown := [each for each in methods if each not in known]:
        reasons.append(f"--methods: expected some of {known}, given {unknown}")
    for option, values in (("--methods", list(methods)), ("--seeds", list(seeds))):
        if not values or len(set(values)) < len(values):
            reasons.append(f"{option}: expected one or more, each once, given {values}")
    if steps < 1:
        reasons.append(f"--steps: expected a number >= 1, given {steps}")
    for each in overrides:
        key, separator, _ = each.lstrip("+~").partition("=")
        if not separator or key.split(".")[0] in PRESENTATION or key in RESERVED:
            reasons.append(
                f"{each!r}: expected KEY=VALUE with a key other than {list(RESERVED)}; for some of "
                "these there is an option, see --help"
            )
    if not reasons:
        for method in methods:
            try:
                Job(method, seeds[0], steps, tuple(overrides)).settings()
            except HydraException as error:
                reasons.append(f"{method}: {error}")
    if reasons:
        raise PlanError("\n".join(reasons))
    return [Job(method, seed, steps, tuple(overrides)) for seed in seeds for method in methods]


def still_to_do(jobs: Sequence[Job], data: Path) -> list[Job]:
    """Return the jobs without a record.

    Raises:
        PlanError: where the file of a record is broken, or of a run with another configuration.
    """
    left, reasons = [], []
    for job in jobs:
        path = data / job.method / f"seed_{job.seed}.json"
        if not path.exists():
            left.append(job)
            continue
        try:
            record = load_record(path)
        except RecordError as error:
            reasons.append(f"{error}; move the file away, then the run is repeated")
            continue
        if differing := [
            f"{name} ({given}, asked for {wanted})"
            for name, (given, wanted) in differences(record.config, job.settings()).items()
        ]:
            reasons.append(
                f"{path}: expected a run with the configuration asked for, given one that differs "
                f"in {differing}; choose another folder with --data, or move the file away"
            )
    if reasons:
        raise PlanError("\n".join(reasons))
    return left


def finished_folder(job: Job, runs: Path) -> Path | None:
    """Return the folder of a finished run of the job, of which there is no record yet."""
    for path in sorted((runs / job.method).glob(f"seed_{job.seed}*")):
        if (path / SUMMARY).is_file() and settings(
            RunFolder(path).load_settings()
        ) == job.settings():
            return path
    return None


def fresh_folder(job: Job, runs: Path) -> Path:
    """Make a new folder for the job; those of killed runs before it are left as they are."""
    attempt = 1
    while True:
        suffix = "" if attempt == 1 else f"_attempt_{attempt}"
        path = runs / job.method / f"seed_{job.seed}{suffix}"
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            attempt += 1
        else:
            return path
