"""All that a run needs to go on as if it had never stopped: saved when due, and brought back."""

from __future__ import annotations

import math
import shutil
import warnings
from collections.abc import Mapping
from typing import Any

from torch import nn
from torch.optim import Optimizer

from cnfp_torchrl.training.checkpoints import CheckpointError, Checkpoints, Stateful, restore
from cnfp_torchrl.training.log_files import cut_logs
from cnfp_torchrl.training.run_folder import BEST, STATES, RunFolder
from cnfp_torchrl.training.settings import CheckpointSettings
from cnfp_torchrl.training.stored_transitions import StoredTransitions


class BrokenCheckpointWarning(UserWarning):
    """The newest state of a run cannot be read, so that an older one is gone on from."""


class RunState:
    """The state of a run, in files that grow with the run by what is new.

    Args:
        folder: The run's folder.
        settings: The settings of how often states are saved.
    """

    def __init__(self, folder: RunFolder, settings: CheckpointSettings) -> None:
        self._folder, self._settings = folder, settings
        self._checkpoints = Checkpoints(folder.path / STATES, settings.keep)
        self._components: dict[str, Stateful] = {}
        self._transitions: StoredTransitions | None = None
        self._saved: dict[str, Any] | None = None
        self._saved_at = 0

    def load(self) -> int:
        """Read the newest state that is whole; return its steps, or 0 where there is no state.

        Raises:
            CheckpointError: when there are states and none can be read.
        """
        broken: CheckpointError | None = None
        for frames in reversed(self._checkpoints.frames()):
            try:
                self._saved = self._checkpoints.load(frames)
            except CheckpointError as error:
                broken = error
                continue
            if broken is not None:
                message = f"{broken}; the run goes on at step {frames}"
                warnings.warn(message, BrokenCheckpointWarning, stacklevel=2)
            self._saved_at = frames
            return frames
        if broken is not None:
            raise broken
        return 0

    def drop_what_came_after(self) -> None:
        """Remove the states and the entries of logs after the state that was loaded.

        So are files that were half written. To be called before the loggers are made.
        """
        self._folder.remove_partial_files()
        self._checkpoints.drop_after(self._saved_at)
        logged_at = evaluated_at = 0
        if self._saved is not None:
            logged_at = self._saved["metrics"]["logged_at"]
            evaluated_at = max(
                (e["step"] for e in self._saved["evaluations"]["history"]), default=0
            )
        cut_logs(self._folder.path, logged_at, evaluated_at)

    def restore(
        self, components: Mapping[str, Stateful], transitions: StoredTransitions | None
    ) -> None:
        """Give the components of the run the state that was loaded, if any, and keep track of them.

        Args:
            components: Everything that has a state, by name. The order counts: what draws random
                numbers while it takes its state comes before what holds the random state.
            transitions: The replay buffer, if what it holds is needed from one step to the next.

        Raises:
            CheckpointError: when the state is of other components.
        """
        self._components = dict(components)
        self._transitions = transitions
        if transitions is not None:
            self._components = {"transitions": transitions, **components}
        if self._saved is not None:
            restore(self._components, self._saved, self._checkpoints.path)
            self._saved = None

    def is_due(self, frames: int) -> bool:
        """Tell whether a state is to be saved after this many steps."""
        interval = self._settings.interval
        return interval is not None and frames // interval > self._saved_at // interval

    def save(self, frames: int) -> None:
        """Save the state after this many steps.

        Raises:
            CheckpointError: when a file cannot be written; the states before stay as they are.
        """
        if self._settings.interval is None:
            return
        if self._transitions is not None:
            self._transitions.save()
        self._checkpoints.save(frames, self._components)
        if self._transitions is not None:
            self._transitions.forget(self._checkpoints.frames()[0])
        self._saved_at = frames

    def finish(self) -> None:
        """Remove the states of a finished run, unless they are to be kept."""
        if not self._settings.keep_last:
            shutil.rmtree(self._checkpoints.path, ignore_errors=True)


class BestPolicy:
    """Keep the policy that scored best without a violation.

    Args:
        folder: The run's folder, in which it is kept as `BEST`.
        modules: What is kept of it, by name, as in the last policy's checkpoint.
    """

    def __init__(self, folder: RunFolder, **modules: nn.Module | Optimizer) -> None:
        self._folder, self._modules = folder, modules
        self.score = -math.inf
        self.violations = 0

    def offer(self, score: float, violations: int) -> None:
        """Keep the policy if it is better than the best so far.

        Args:
            score: Its score, or its return where a task has no score; NaN where none is known.
            violations: All violations so far; those since the last offer count.
        """
        is_clean, self.violations = violations == self.violations, violations
        if is_clean:
            self._keep_if_better(score)

    def offer_evaluation(self, report: Mapping[str, Any]) -> None:
        """Keep the policy if an evaluation during training says that it is better, and clean.

        Args:
            report: The evaluation's ``return_mean``, ``score`` and ``violations``.
        """
        if not any(report["violations"].values()):
            score = report["return_mean"] if report["score"] is None else report["score"]
            self._keep_if_better(score)

    def _keep_if_better(self, score: float) -> None:
        if score > self.score:
            self._folder.save_checkpoint(BEST, **self._modules)
            self.score = score
