"""Runs as processes of their own: started, watched and stopped."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from experiments.paper.plan import Job, finished_folder, fresh_folder

PATIENCE = 10.0
"""Seconds that a process has to stop when asked, before it is killed."""

LOG = "output.log"


class RunningJob:
    """A job that is under way: training, then the record.

    Args:
        job: what to do.
        runs: folder of the runs' folders; a finished run of this job in there is not repeated.
        data: folder of the records.
    """

    def __init__(self, job: Job, runs: Path, data: Path) -> None:
        self.job = job
        self._data = data
        finished = finished_folder(job, runs)
        self.folder = finished or fresh_folder(job, runs)
        self.log = self.folder / LOG
        self._collecting = finished is not None
        self._process = self._start(self._collect if finished else self._train)

    def poll(self) -> int | None:
        """Return the exit status when all is done or something failed, ``None`` before."""
        status = self._process.poll()
        if status == 0 and not self._collecting:
            self._collecting = True
            self._process = self._start(self._collect)
            return None
        return status

    @property
    def steps(self) -> int:
        """Environment steps done, as far as the run has logged them."""
        if self._collecting:
            return self.job.steps
        try:
            rows = (self.folder / "metrics/scalars/train/seconds.csv").read_text().splitlines()
            return int(rows[-1].split(",")[0])
        except (OSError, ValueError, IndexError):
            return 0

    @property
    def stage(self) -> str:
        """What is being done."""
        return "evaluating" if self._collecting else "training"

    def last_words(self, lines: int = 3) -> str:
        """Return the end of the log."""
        text = self.log.read_text(errors="replace").replace("\r", "\n")
        return "\n".join([line for line in text.splitlines() if line.strip()][-lines:])

    def ask_to_stop(self) -> None:
        """Ask the process, and what it has started, to stop."""
        self._signal(signal.SIGTERM)

    def stop(self) -> None:
        """Wait for a process that was asked to stop; kill it when it does not."""
        try:
            self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._signal(signal.SIGKILL)
            self._process.wait()

    @property
    def _train(self) -> list[str]:
        # Hydra reads the value with a grammar of its own, in which quotes protect everything else.
        quoted = str(self.folder.resolve()).replace("\\", "\\\\").replace("'", "\\'")
        folder = f"hydra.run.dir='{quoted}'"
        return ["cnfp_torchrl.training.train", *self.job.arguments, folder]

    @property
    def _collect(self) -> list[str]:
        return ["experiments.paper.collect", str(self.folder.resolve()), str(self._data.resolve())]

    def _start(self, module: list[str]) -> subprocess.Popen[bytes]:
        # In a session of its own it does not get the terminal's Ctrl-C: it is stopped from here.
        with self.log.open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", *module],
                cwd=Path(__file__).parents[2],
                env={**os.environ, "OMP_NUM_THREADS": "1"},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def _signal(self, number: signal.Signals) -> None:
        if self._process.poll() is None:
            os.killpg(self._process.pid, number)


def stop_all(running: list[RunningJob]) -> None:
    """Stop all of them, asking all before waiting for any."""
    for each in running:
        each.ask_to_stop()
    for each in running:
        each.stop()
