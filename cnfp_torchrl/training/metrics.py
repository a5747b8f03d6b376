"""Counts and log of a training run."""

from __future__ import annotations

import math
import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.record.loggers import CSVLogger, Logger, TensorboardLogger, WandbLogger
from tqdm import tqdm

from cnfp_torchrl.training.constraint_counts import (
    NOT_COUNTED,
    ConstraintCounts,
    ConstraintTally,
    violations_of,
)
from cnfp_torchrl.training.log_files import EVALUATION


class Metrics:
    """Counts of returns, violations and relaxations, the log of scalars, and the progress bar.

    Args:
        loggers: TorchRL loggers; each scalar goes to all of them.
        tally: The tally of the environment's constraints, which has counted nothing yet.
        total_frames: The length of the run, in environment steps.
        interval: The environment steps between two entries of the log.
    """

    def __init__(
        self,
        loggers: Iterable[Logger],
        tally: ConstraintTally,
        *,
        total_frames: int,
        interval: int,
    ) -> None:
        self.frames = 0
        # The run's own times, which begin earlier where it goes on from a checkpoint.
        self._started = [time.perf_counter(), time.process_time()]
        self._logged_at = 0
        self._recent, self._before = tally, tally.counts()
        self._loggers = list(loggers)
        self._interval = interval
        self._next_log = interval
        self._returns: list[Tensor] = []
        self._losses: dict[str, list[Tensor]] = defaultdict(list)
        self._last_return = math.nan
        # In a file each redrawing of the bar is another line.
        pause = 0.1 if sys.stderr.isatty() else 10.0
        self._bar = tqdm(total=total_frames, unit="step", dynamic_ncols=True, mininterval=pause)

    def counts(self) -> dict[str, ConstraintCounts]:
        """Return what happened to each constraint so far."""
        recent = self._recent.counts()
        return {name: before + recent[name] for name, before in self._before.items()}

    @property
    def last_return(self) -> float:
        """The mean return at the last entry of the log; NaN before the first episode has ended."""
        return self._last_return

    @property
    def seconds(self) -> float:
        """The time of the run so far, without pauses before it was resumed."""
        return time.perf_counter() - self._started[0]

    def state_dict(self) -> dict[str, Any]:
        """Return all counts and what the next entry of the log will tell; flushes the loggers."""
        for logger in self._loggers:
            logger.flush()
        return {
            "frames": self.frames,
            "logged_at": self._logged_at,
            "next_log": self._next_log,
            "seconds": [self.seconds, time.process_time() - self._started[1]],
            "before": {name: asdict(counts) for name, counts in self._before.items()},
            "recent": self._recent.state_dict(),
            "returns": list(self._returns),
            "losses": {name: list(values) for name, values in self._losses.items()},
            "last_return": self._last_return,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a state that `state_dict` has returned."""
        self.frames, self._logged_at = state["frames"], state["logged_at"]
        self._next_log = state["next_log"]
        clocks = time.perf_counter(), time.process_time()
        self._started = [now - past for now, past in zip(clocks, state["seconds"], strict=True)]
        self._before = {n: ConstraintCounts(**counts) for n, counts in state["before"].items()}
        self._recent.load_state_dict(state["recent"])
        self._returns = list(state["returns"])
        self._losses.update({name: list(values) for name, values in state["losses"].items()})
        self._last_return = state["last_return"]
        self._bar.initial = self._bar.n = self.frames
        self._bar.refresh()

    def add_steps(self, batch: TensorDictBase) -> None:
        """Count a batch ``(steps,)`` of transitions."""
        self._recent.add(batch)
        outcome = batch.get("next")
        done = outcome.get("done").squeeze(-1)
        if bool(done.any()):
            self._returns.append(outcome.get("episode_reward")[done].flatten())
        self.frames += batch.numel()
        self._bar.update(batch.numel())

    def add_losses(self, losses: TensorDictBase) -> None:
        """Remember the losses of an update for the next entry of the log."""
        for name, value in losses.items():
            self._losses[name].append(value.detach())

    def add_evaluation(self, report: Mapping[str, Any]) -> None:
        """Write an evaluation into the log, together with an entry of training.

        Args:
            report: Its ``return_mean``, ``score`` and ``violations``.
        """
        self.finish()  # so that what is logged up to here is what a resumed run keeps
        self._log(f"{EVALUATION}return", report["return_mean"])
        if report["score"] is not None:
            self._log(f"{EVALUATION}score", report["score"])
        for name, count in report["violations"].items():
            if count is not None:
                self._log(f"{EVALUATION}violations/{name}", count)

    def log_if_due(self) -> None:
        """Write an entry of the log when the interval has passed.

        Raises:
            FloatingPointError: when a loss or a return is not finite.
        """
        if self.frames >= self._next_log:
            self._next_log += self._interval
            self._log_entry()

    def finish(self) -> None:
        """Write what is left as a last entry.

        Raises:
            FloatingPointError: when a loss or a return is not finite.
        """
        if self.frames > self._logged_at:
            self._log_entry()

    def close(self) -> None:
        """Finish the progress bar and end what the loggers started."""
        self._bar.close()
        for logger in self._loggers:
            # Their threads and processes would outlive the run.
            if isinstance(logger, TensorboardLogger | WandbLogger):
                logger.close()
            elif isinstance(logger, CSVLogger):
                for file in logger.experiment.files.values():
                    file.close()

    def _log_entry(self) -> None:
        self._logged_at = self.frames
        wall, processor = self._started
        self._log("train/seconds", time.perf_counter() - wall)
        self._log("train/processor_seconds", time.process_time() - processor)
        if self._returns:
            self._last_return = self._finite("return", torch.cat(self._returns))
            self._log("train/return", self._last_return)
            self._returns.clear()
        total = self._log_constraints()
        for name, values in self._losses.items():
            mean = self._finite(name, torch.stack(values))
            is_loss = name.startswith("loss_")
            self._log(f"loss/{name.removeprefix('loss_')}" if is_loss else f"train/{name}", mean)
        self._losses.clear()
        speed = self._bar.format_dict["rate"]
        if speed:
            self._log("train/steps_per_second", speed)
        ended = not math.isnan(self._last_return)
        episodes = f"return {self._last_return:.1f}" if ended else "no episode has ended yet"
        self._bar.set_postfix_str(f"{episodes}, violations {total}")

    def _log_constraints(self) -> str:
        """Log the constraints' counts, and return all violations so far as text."""
        for name, recent in self._recent.counts().items():
            if recent.steps:
                self._log(f"relaxed/{name}", recent.share("relaxed"))
                self._log(f"dropped/{name}", recent.share("dropped"))
                self._log(f"relaxation/{name}", recent.largest_relaxation)
                self._log(f"mean_relaxation/{name}", recent.mean_relaxation)
        self._before, self._recent = self.counts(), self._recent.fresh()
        counted = {k: n for k, n in violations_of(self._before).items() if n is not None}
        for name, count in counted.items():
            self._log(f"violations/{name}", count)
        return str(sum(counted.values())) if counted else NOT_COUNTED

    def _finite(self, name: str, values: Tensor) -> float:
        mean = float(values.mean())
        if not math.isfinite(mean):
            raise FloatingPointError(
                f"{name} became {mean} by step {self.frames}: the run has diverged; lower "
                "optim.lr, or look at the logged losses"
            )
        return mean

    def _log(self, name: str, value: float) -> None:
        for logger in self._loggers:
            logger.log_scalar(name, value, step=self.frames)
