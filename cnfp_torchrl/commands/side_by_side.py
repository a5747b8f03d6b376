"""The processes of a sweep whose runs go side by side: how they are stopped together.

joblib hands run after run to each of its workers. When the process that started them raises, or one
worker dies, joblib kills the others at once, whatever they have not saved.
"""

from __future__ import annotations

import os
import shlex
import signal
import sys
import time
from contextlib import suppress
from multiprocessing import active_children
from pathlib import Path
from types import FrameType

from hydra.conf import HydraConf
from omegaconf import DictConfig

from cnfp_torchrl.training.interruption import STOP_SIGNALS, TrainingInterrupted
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.sweep import OVERRIDES

_stopped: list[TrainingInterrupted] = []
"""Why this worker begins no further run."""


def is_side_by_side(hydra: DictConfig | HydraConf) -> bool:
    """Tell whether runs are those of joblib's workers, by Hydra's own configuration."""
    return str(hydra.launcher["_target_"]).endswith(".JoblibLauncher")


def begin_run() -> None:
    """Let signals end this worker's runs, of which none begins after one was stopped.

    Raises:
        TrainingInterrupted: when one was.
    """
    if _stopped:
        raise _stopped[0]
    for number in STOP_SIGNALS:
        signal.signal(number, _stop_run)


def end_run() -> None:
    """Let signals alone keep this worker from further runs: joblib kills all when one dies."""
    for number in STOP_SIGNALS:
        signal.signal(number, _begin_no_other)


def as_stop(reason: SystemExit | TrainingInterrupted) -> TrainingInterrupted | None:
    """Return the signal that ended a worker's run, which then begins no further one; else None."""
    if isinstance(reason, TrainingInterrupted):
        stop = reason
    elif reason.code in [128 + number for number in STOP_SIGNALS]:
        stop = TrainingInterrupted(int(reason.code or 0) - 128, "stopped")
    else:
        return None
    _stopped.append(stop)
    return stop


def _begin_no_other(number: int, frame: FrameType | None) -> None:
    _stopped.append(TrainingInterrupted(number, "stopped"))


def _stop_run(number: int, frame: FrameType | None) -> None:
    """Stop a run that is not in training, where it would save its state first."""
    raise TrainingInterrupted(number, "stopped outside of training")


def stop_when_runs_are_saved(sweep: Path) -> None:
    """Let SIGTERM and Ctrl-C end this process, which started a sweep, when its runs are saved.

    Args:
        sweep: The sweep's folder.
    """

    def stop(number: int, frame: FrameType | None) -> None:
        obey_signals()
        name = signal.Signals(number).name
        sys.stderr.write(f"\n{name}: the sweep stops when its runs are saved; again: at once\n")
        for worker in active_children():
            # To those that a terminal or Slurm has told already, it counts as the same.
            if worker.pid is not None:
                with suppress(ProcessLookupError):
                    os.kill(worker.pid, number)
        while any(RunFolder(path.parent.parent).is_held for path in sweep.glob(f"**/{OVERRIDES}")):
            time.sleep(0.1)
        command = f"cnfp-sweep {shlex.quote(str(sweep))} --resume"
        raise TrainingInterrupted(number, f"stopped; go on with: {command}")

    for number in STOP_SIGNALS:
        signal.signal(number, stop)


def obey_signals() -> None:
    """Let signals end this process at once."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)


def wait_for_workers() -> None:
    """Wait until the workers have ended, which joblib kills where one of them has died."""
    for worker in active_children():
        worker.join()
