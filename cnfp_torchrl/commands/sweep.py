"""Tell what came of a sweep: the command ``cnfp-sweep``, and the end of ``cnfp-train -m``."""

from __future__ import annotations

import argparse
import csv
import io
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from cnfp_torchrl.commands.extras import needs_extra
from cnfp_torchrl.commands.run_options import TRUSTED

with needs_extra("train"):
    from cnfp_torchrl.commands.paths import quoted
    from cnfp_torchrl.commands.refusals import errors_in_a_sentence
    from cnfp_torchrl.commands.sweep_folders import config_arguments, planned_runs
    from cnfp_torchrl.text_table import text_table
    from cnfp_torchrl.training.run_folder import RunFolder
    from cnfp_torchrl.training.sweep import SEED, Mean, SweepRun, over_seeds, read_sweep, varied
    from cnfp_torchrl.visual.figures.sweep import save_sweep
    from cnfp_torchrl.whole_file import whole_file

TABLE, MEANS, FIGURE = "sweep.csv", "sweep_means.csv", "sweep.png"
"""The files in the sweep's folder."""


def run_rows(runs: Sequence[SweepRun], *, with_reasons: bool = True) -> list[list[str]]:
    """Return a header and a row for each run.

    Args:
        runs: The runs.
        with_reasons: Whether the state of a run that failed or was stopped says why.
    """
    keys = varied(runs)
    rows = [[*keys, "score", "violations", "relaxation", "seconds", "folder", "state"]]
    for run in runs:
        numbers = (run.score, run.violations, run.relaxation, run.seconds)
        state = f"{run.state}: {run.reason}" if with_reasons and run.reason else run.state
        settings = [run.overrides.get(key, "") for key in keys]
        rows.append([*settings, *map(_number, numbers), run.path.name, state])
    return rows


def mean_rows(runs: Sequence[SweepRun]) -> list[list[str]]:
    """Return a header and a row for each setting: means over its seeds, with 95 % intervals."""
    keys = [key for key in varied(runs) if key != SEED]
    rows = [[*keys, "runs", "done", "score", "+-", "violations", "relaxation", "seconds"]]
    for settings, group in over_seeds(runs).items():
        done = [run for run in group if run.is_done]
        scores = [run.score for run in done if run.score is not None]
        mean = Mean.of(scores) if scores else Mean(float("nan"), None)
        rows.append(
            [
                *settings,
                str(len(group)),
                str(len(done)),
                _number(mean.value if scores else None),
                _number(mean.half_width),
                _number(_sum([run.violations for run in done])),
                _number(
                    max((r.relaxation for r in done if r.relaxation is not None), default=None)
                ),
                _number(_sum([run.seconds for run in done])),
            ]
        )
    return rows


def _sum(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) if known else None


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return str(value) if isinstance(value, int) else f"{value:.4g}"


def report(folder: Path) -> str:
    """Write table, means and figure of a sweep into its folder, and return both tables as text.

    Why runs failed or were stopped stands below the table, which it would make too wide.
    """
    runs = read_sweep(folder, planned_runs(folder))
    tables = {TABLE: run_rows(runs)}
    if SEED in varied(runs):
        tables[MEANS] = mean_rows(runs)
    for name, rows in tables.items():
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(rows)
        with whole_file(folder / name) as file:
            file.write(text.getvalue().encode())
    save_sweep(runs, folder / FIGURE)
    shown = tables | {TABLE: run_rows(runs, with_reasons=False)}
    tables_as_text = [text_table(rows) for rows in shown.values()]
    reasons = [f"{run.path.name} {run.state}: {run.reason}" for run in runs if run.reason]
    files = ", ".join(str(folder / name) for name in (*tables, FIGURE))
    return "\n\n".join(["\n".join([tables_as_text[0], *reasons]), *tables_as_text[1:], files])


def resume(
    folder: Path,
    *,
    jobs: int,
    trusted: Sequence[str] = (),
    states: Sequence[str] = ("failed", "stopped", "not started"),
) -> Iterator[str]:
    """Go on with the runs that are neither done nor running; yield a line for each when it ends.

    Args:
        folder: The sweep's folder.
        jobs: The number of runs at a time, each in a process of its own.
        trusted: The names that their configurations may use, as ``trusted`` of ``cnfp-train``.
        states: The states that runs are gone on from.
    """

    def go_on(run: SweepRun) -> str:
        path = run.path.absolute()
        if RunFolder(run.path).has_started:
            arguments = [f"resume={path}", f"trusted=[{','.join(map(quoted, trusted))}]"]
        else:
            arguments = [
                *config_arguments(folder),
                *run.given,
                f"hydra.run.dir={quoted(str(path))}",
            ]
        done = subprocess.run(
            [sys.executable, "-m", "cnfp_torchrl.commands.train", *arguments],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
        if done.returncode == 0:
            return f"{run.path}: done"
        if done.returncode < 0 and run.path.is_dir():
            name = signal.Signals(-done.returncode).name
            RunFolder(run.path).save_failure(ChildProcessError(f"ended by {name}"))
        return f"{run.path}: {RunFolder(run.path).load_failure() or done.stderr.strip()}"

    runs = read_sweep(folder, planned_runs(folder))
    unfinished = [run for run in runs if run.state in states]
    with ThreadPoolExecutor(jobs) as pool:
        yield from pool.map(go_on, unfinished)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print and write the table of a sweep, and go on with what is not done if asked to."""
    parser = argparse.ArgumentParser(
        prog="cnfp-sweep",
        description="Tell what came of a sweep of cnfp-train -m.",
        parents=[TRUSTED],
    )
    parser.add_argument("folder", type=Path, help="the sweep's folder, multirun/DATE/TIME")
    parser.add_argument("--resume", action="store_true", help="go on with runs that are not done")
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time (1)")
    options = parser.parse_args(arguments)
    if options.jobs < 1:
        parser.error(f"--jobs: expected a number >= 1, given {options.jobs}")
    with errors_in_a_sentence(parser.prog):
        if options.resume:
            for line in resume(options.folder, jobs=options.jobs, trusted=options.trusted):
                sys.stdout.write(f"{line}\n")
        sys.stdout.write(f"{report(options.folder)}\n")


if __name__ == "__main__":
    main()
