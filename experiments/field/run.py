"""Do the field's training runs, many side by side, and keep a record of each.

    python -m experiments.field.run [--jobs 16] [--minutes 9] [--tasks ...] [--methods ...]
        [--seeds 0 1 2] [--device cuda] [--data FOLDER] [key=value ...]

Each run is a process with one thread. What has a record already is not run again, so the same
command goes on where it was stopped, or where its time was up. A run that fails does not hold up
the others; the exit status tells.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from experiments.field.jobs import ACTION_SIZES, DATA, METHODS, TRAINED, Job, all_jobs

PAUSE = 0.2
"""Seconds between two looks at the processes."""


@dataclass
class Running:
    """A run's process.

    Args:
        job: What it runs.
        process: The process.
        log: The file that gets its output.
        since: When it began.
    """

    job: Job
    process: subprocess.Popen[bytes]
    log: IO[bytes]
    since: float


def run_all(
    jobs: list[Job], data: Path, *, side_by_side: int, seconds: float, overrides: list[str]
) -> tuple[list[Job], list[Job]]:
    """Do what has no record, until the time is up.

    Args:
        jobs: The runs.
        data: The folder of the records.
        side_by_side: The number of runs at the same time.
        seconds: The time after which what is not finished is stopped.
        overrides: What each gets beside the shared settings.

    Returns:
        Runs that failed, and runs that are left.
    """
    began = time.perf_counter()
    waiting = [job for job in jobs if not job.path(data).exists()]
    tell(f"{len(jobs) - len(waiting)} of {len(jobs)} runs have a record")
    running: list[Running] = []
    failed: list[Job] = []
    try:
        while waiting or running:
            if time.perf_counter() - began > seconds:
                break
            while waiting and len(running) < side_by_side:
                running.append(start(waiting.pop(0), data, overrides))
            time.sleep(PAUSE)
            for run in [run for run in running if run.process.poll() is not None]:
                running.remove(run)
                run.log.close()
                taken = time.perf_counter() - run.since
                if run.process.returncode:
                    failed.append(run.job)
                    tell(f"FAILED after {taken:.0f} s: {run.job}, see {run.log.name}")
                else:
                    tell(f"done in {taken:.0f} s: {run.job}")
    finally:
        for run in running:
            run.process.terminate()
        for run in running:
            run.process.wait()
            run.log.close()
    return failed, [run.job for run in running] + waiting


def start(job: Job, data: Path, overrides: list[str]) -> Running:
    """Start a run's process."""
    path = job.path(data)
    path.parent.mkdir(parents=True, exist_ok=True)
    log = path.with_suffix(".log").open("wb")
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    command = [
        sys.executable,
        "-m",
        "experiments.field.single_run",
        job.task,
        job.method,
        str(job.seed),
    ]
    process = subprocess.Popen(
        [*command, "--data", str(data), *overrides],
        stdout=log,
        stderr=subprocess.STDOUT,
        env={**os.environ, **threads},
    )
    return Running(job, process, log, time.perf_counter())


def tell(line: str) -> None:
    """Print a line at once."""
    print(line, flush=True)


def arguments() -> Any:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", nargs="+", choices=list(ACTION_SIZES), default=list(TRAINED))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="side by side")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="then stop")
    parser.add_argument("--device", help="of networks and updates, such as cuda; else the default")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the records")
    given, overrides = parser.parse_known_args()
    if foreign := [text for text in overrides if text.startswith("-") or "=" not in text]:
        parser.error(f"expected key=value, given {foreign}")
    given.overrides = overrides + ([f"device={given.device}"] if given.device else [])
    return given


def main() -> None:
    """Do what the command line names."""
    given = arguments()
    jobs = all_jobs(tuple(given.tasks), tuple(given.methods), tuple(given.seeds))
    failed, left = run_all(
        jobs,
        given.data,
        side_by_side=given.jobs,
        seconds=60 * given.minutes,
        overrides=given.overrides,
    )
    if failed or left:
        sys.exit(f"{len(failed)} runs failed, {len(left)} are left; the same command goes on")


if __name__ == "__main__":
    main()
