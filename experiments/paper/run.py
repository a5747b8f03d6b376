"""Run methods and seeds side by side, and keep a record of each: ``python -m experiments.paper``.

Records go to ``DATA/METHOD/seed_S.json``, runs with their checkpoints and logs to
``RUNS/METHOD/seed_S/``. What has a record already is not run again, so the same command goes on
where it was stopped. Figures and report are drawn at the end from all records of the folder.
"""

from __future__ import annotations

import argparse
import fcntl
import os
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from experiments.paper.jobs import RunningJob, stop_all
from experiments.paper.plan import Job, PlanError, known_methods, make_jobs, still_to_do
from experiments.paper.progress import Progress, make_progress
from experiments.paper.records import RecordError

OUTPUT = Path("outputs/paper")
PAUSE = 0.5
"""Seconds between two looks at the running processes."""


class Stopped(Exception):
    """A signal asked to stop; its number is the argument."""


def run_jobs(
    jobs: Sequence[Job],
    runs: Path,
    data: Path,
    *,
    parallel: int,
    progress: Progress,
    signals: Sequence[int] = (),
) -> list[str]:
    """Do all jobs, some at a time; one that fails does not hold up the others.

    Args:
        jobs: in this order.
        runs: folder of the runs.
        data: folder of the records.
        parallel: how many at a time.
        progress: where to show how far it is.
        signals: filled from outside with those that came, see `signals_noted`.

    Returns:
        a sentence for each job that failed.

    Raises:
        Stopped: when a signal came; all processes are then stopped.
    """
    waiting, running, finished = list(jobs), list[RunningJob](), 0
    failures: list[str] = []
    try:
        while waiting or running:
            if signals:
                raise Stopped(signals[0])
            while waiting and len(running) < parallel:
                running.append(RunningJob(waiting.pop(0), runs, data))
                progress.say(f"{running[-1].job.name}: started, log in {running[-1].log}")
            for each in list(running):
                status = each.poll()
                if status is None:
                    continue
                running.remove(each)
                if status == 0:
                    finished += 1
                    progress.say(f"{each.job.name}: done")
                else:
                    failures.append(f"{each.job.name}: exit status {status}, log in {each.log}")
                    progress.say(f"FAILED: {failures[-1]}\n{each.last_words()}")
            progress.show(running, finished, len(failures))
            time.sleep(PAUSE)
    finally:
        stop_all(running)
    return failures


@contextmanager
def signals_noted() -> Iterator[list[int]]:
    """Note the signals that usually end a program in a list, in place of obeying them.

    An exception from a handler could come between the start of a process and its being known.
    """
    noted: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        noted.append(number)

    before = {n: signal.signal(n, note) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield noted
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def only_one(folder: Path) -> Iterator[None]:
    """Hold a folder for this process.

    Raises:
        PlanError: when another one holds it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise PlanError(
                f"--runs: expected a folder that nobody else uses, but another command works in "
                f"{folder}; wait for it, or choose another folder"
            ) from None
        yield


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, collect, draw and report; return 1 if a run failed, 2 if nothing could start."""
    options = _parser().parse_args(arguments)
    data = options.data or options.output / "data"
    runs = options.runs or options.output / "runs"
    try:
        methods = options.methods or known_methods()
        jobs = make_jobs(methods, options.seeds, options.steps, options.overrides)
        with only_one(runs):
            left = still_to_do(jobs, data)
            sys.stderr.write(
                f"{len(jobs)} runs, {len(jobs) - len(left)} of them done before; "
                f"records in {data}, runs in {runs}\n"
            )
            parallel = min(options.parallel, max(len(left), 1))
            show = make_progress(len(left), options.steps, parallel)
            with signals_noted() as signals, show as progress:
                failures = run_jobs(
                    left, runs, data, parallel=parallel, progress=progress, signals=signals
                )
    except PlanError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    except Stopped as stopped:
        sys.stderr.write("stopped; the same command goes on from the last finished run\n")
        return 128 + int(stopped.args[0])
    if not options.no_report:
        # Imported late: what draws must not keep anything from running.
        from experiments.paper.report import write_report

        try:
            sys.stderr.write(f"report: {write_report(data, options.output)}\n")
        except RecordError as error:
            failures.append(f"report: {error}")
    for failure in failures:
        sys.stderr.write(f"FAILED: {failure}\n")
    return 1 if failures else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m experiments.paper", description=__doc__)
    add = parser.add_argument
    add("--methods", type=_names, help="comma-separated; all of conf/experiment if left out")
    add("--seeds", type=_seeds, default=[0, 1, 2], help="such as 0,1,2 (default) or 0-4")
    add("--steps", type=int, default=20_000, help="environment steps of training (%(default)s)")
    add("--parallel", type=_positive, default=os.cpu_count() or 1, help="runs at the same time")
    add("--output", type=Path, default=OUTPUT, help="of everything that follows (%(default)s)")
    add("--data", type=Path, help="of the records; OUTPUT/data if left out")
    add("--runs", type=Path, help="of the runs' own folders; OUTPUT/runs if left out")
    add("--no-report", action="store_true", help="stop after the records")
    add("overrides", nargs="*", metavar="KEY=VALUE", help="of the training configuration")
    return parser


def _names(text: str) -> list[str]:
    return [each.strip() for each in text.split(",") if each.strip()]


def _seeds(text: str) -> list[int]:
    seeds: list[int] = []
    for part in _names(text):
        first, separator, last = part.partition("-")
        if not first.isdecimal() or (separator and not last.isdecimal()):
            raise argparse.ArgumentTypeError(
                f"expected whole numbers and ranges such as 0,1,2 or 0-4, given {text!r}"
            )
        seeds += range(int(first), int(last if separator else first) + 1)
    return seeds


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number >= 1, given {text!r}")
    return int(text)
