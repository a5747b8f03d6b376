"""Train a policy on a constrained environment: the command ``cnfp-train``."""

from __future__ import annotations

import math
import os
import shlex
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from cnfp_torchrl.commands.extras import needs_extra

with needs_extra("train"):
    from hydra.core.hydra_config import HydraConfig
    from hydra.utils import instantiate
    from omegaconf import DictConfig, OmegaConf

    from cnfp_torchrl.commands.hydra_command import hydra_command, is_sweep
    from cnfp_torchrl.commands.refusals import WITH_TRACEBACKS, write_error
    from cnfp_torchrl.commands.side_by_side import obey_signals, wait_for_workers
    from cnfp_torchrl.commands.sweep import report, resume
    from cnfp_torchrl.commands.sweep_folders import (
        STARTED,
        planned_runs,
        processes,
        with_common_keys,
    )
    from cnfp_torchrl.configuration import foreign_packages
    from cnfp_torchrl.training.callbacks import RECORDING
    from cnfp_torchrl.training.constraint_counts import NOT_COUNTED, count_text, gave_way_text
    from cnfp_torchrl.training.interruption import TrainingInterrupted
    from cnfp_torchrl.training.provenance import remember_command
    from cnfp_torchrl.training.resume import resumed_config
    from cnfp_torchrl.training.run_folder import RunFolder
    from cnfp_torchrl.training.sweep import read_sweep, run_folders
    from cnfp_torchrl.training.train import train
    from cnfp_torchrl.whole_file import whole_file

_HYDRA_FILES = ("config", "hydra", "overrides")


def _save_hydra_files(folder: RunFolder, config: DictConfig) -> None:
    """Write Hydra's own files, which Hydra would write over those of a run that has the folder."""
    hydra_config = HydraConfig.get()
    contents = [config, {"hydra": hydra_config}, hydra_config.overrides.task]
    directory = folder.path / ".hydra"
    directory.mkdir(exist_ok=True)
    for name, content in zip(_HYDRA_FILES, contents, strict=True):
        with whole_file(directory / f"{name}.yaml") as file:
            file.write(OmegaConf.to_yaml(content).encode())


def _remove_unless_started(folder: RunFolder) -> None:
    """Remove what a run leaves that was refused before it started: Hydra's files, and the folder.

    Anything else in the folder stays, and the folder with it.
    """
    if folder.has_started:
        return
    log = folder.path / f"{HydraConfig.get().job.name}.log"
    if log.exists() and not log.stat().st_size:
        log.unlink()
    for file in _HYDRA_FILES:
        (folder.path / ".hydra" / f"{file}.yaml").unlink(missing_ok=True)
    with suppress(OSError):
        (folder.path / ".hydra").rmdir()
        folder.path.rmdir()


def _summary_text(summary: Mapping[str, Any]) -> str:
    """Return a line of results, and one for each constraint that gave way or was broken."""
    counts = ", ".join(f"{name} {count_text(n)}" for name, n in summary["violations"].items())
    score = "" if summary["score"] is None else f", score {summary['score']:.3f}"
    lines = [
        f"return {summary['return_mean']:.2f}{score}; violations: {counts or NOT_COUNTED}; "
        f"{summary['steps']} steps in {summary['seconds']:.0f} s"
    ]
    for name, report in summary["constraints"].items():
        if text := gave_way_text(report):
            lines.append(f"{name} {text}")
    return "\n".join(lines)


def _next_steps(folder: RunFolder, config: DictConfig) -> str:
    """Return the commands that look at a run, as they would be typed."""
    path = shlex.quote(str(folder.path))
    foreign = foreign_packages(config)
    lists = " " + shlex.quote(f"trusted=[{','.join(foreign)}]") if foreign else ""
    options = "".join(f" --trusted {name}" for name in foreign)
    commands = [f"cnfp-evaluate run={path}{lists}", f"cnfp-explain {path}{options}"]
    recording = Path(RECORDING)
    if any(folder.path.glob(f"{recording.stem}*{recording.suffix}")):
        commands.append(f"cnfp-view {path}")
    return "next: " + "; ".join(commands)


def _objective(summary: Mapping[str, Any]) -> float:
    """Return what a sweeper maximizes: the score, or the return of a task without one.

    A run that broke a constraint is no candidate, however well it scored.
    """
    if any(summary["violations"].values()):
        return -math.inf
    score = summary["score"]
    return float(summary["return_mean"] if score is None else score)


def _folder_and_config(config: DictConfig) -> tuple[RunFolder, DictConfig]:
    """Return a new folder for a new run, or that of a run to go on with and its configuration."""
    hydra_config = HydraConfig.get()
    output, resumed = hydra_config.runtime.output_dir, config.resume
    overrides = hydra_config.overrides.task
    # Slurm starts a job that was preempted, or ran out of time, once more and in the same way.
    if int(os.environ.get("SLURM_RESTART_COUNT", "0")) and RunFolder(output).has_started:
        folder = RunFolder.resume(output)
        if OmegaConf.to_container(config, resolve=True) == folder.load_settings():
            return folder, config  # of this very command, whose own packages need no trust
        folder.close()
        resumed, overrides = output, []
    if resumed is not None:
        folder = RunFolder.resume(resumed)
        return folder, resumed_config(folder, config, overrides, config.trusted)
    folder = RunFolder.create(output)
    try:
        with folder.naming_what_cannot_be_written():
            _save_hydra_files(folder, config)
    except OSError:
        _remove_unless_started(folder)
        raise
    return folder, config


def _go_on_after_death() -> None:
    """Go on with the runs that a sweep lost with one of its processes, each in one of its own."""
    wait_for_workers()
    obey_signals()
    are_done = True
    for sweep in STARTED:
        sys.stderr.write(
            f"{sweep}: a process was killed, which often means that the memory was full, and with "
            "it those beside it; their runs go on from what they have saved, each in a process of "
            "its own\n"
        )
        # What this very command has begun is trusted.
        lost = ("stopped", "not started")
        for line in resume(sweep, jobs=processes(sweep), trusted=[""], states=lost):
            sys.stderr.write(f"{line}\n")
        planned = planned_runs(sweep)
        if not planned:
            sys.stderr.write(f"{sweep}: the runs that it was yet to have are not known\n")
        are_done &= bool(planned) and all(run.is_done for run in read_sweep(sweep, planned))
    if not are_done:
        sys.exit(1)


@hydra_command("train", _go_on_after_death)
def _main(config: DictConfig) -> float:
    """Train, draw the run's figures, print the summary, and return what a sweep maximizes."""
    folder, config = _folder_and_config(config)
    # The table of a sweep has its runs that were refused, also when they are tried again.
    is_in_table = is_sweep() or folder.load_failure() is not None
    try:
        draw: Callable[[RunFolder], object] | None = instantiate(config.figures) or None
        summary = train(config, folder, resume=folder.has_started)
    except TrainingInterrupted as stop:
        sys.stderr.write(f"{stop}\n")
        sys.exit(128 + stop.number)
    except Exception as error:
        # A complete run has not failed because it was asked to go on.
        if (is_in_table or folder.has_started) and not folder.is_complete:
            folder.save_failure(error)
        raise
    finally:
        if not is_in_table:
            _remove_unless_started(folder)
    folder.forget_failure()
    sys.stdout.write(f"{_summary_text(summary)}\n{folder.path}\n")
    if not is_sweep():
        sys.stdout.write(f"{_next_steps(folder, config)}\n")
    sys.stdout.flush()
    if draw is not None:
        _draw_figures(draw, folder)
    return _objective(summary)


def _draw_figures(draw: Callable[[RunFolder], object], folder: RunFolder) -> None:
    """Draw the figures of a run that is complete, whose score a sweep keeps without them, too."""
    try:
        draw(folder)
    except Exception as error:
        if not is_sweep() or WITH_TRACEBACKS:
            raise
        write_error(error, f"{folder.path}: figures: ")


def main() -> None:
    """Train a run, or the runs of a sweep, of which a table is printed at the end."""
    remember_command("cnfp-train")
    sys.argv[1:] = with_common_keys(sys.argv[1:])
    try:
        try:
            _main()
        finally:
            # Also after a run that failed, which is why the others are worth a look; but not where
            # the launcher was refused before the first.
            while STARTED:
                _report(STARTED.pop(0))
    except TrainingInterrupted as stop:
        sys.stderr.write(f"{stop}\n")
        sys.exit(128 + stop.number)


def _report(sweep: Path) -> None:
    """Print what came of a sweep."""
    if run_folders(sweep):
        sys.stdout.write(f"{report(sweep)}\n")


if __name__ == "__main__":
    main()
