"""Evaluation while training goes on, which training does not notice."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torchrl.envs import EnvBase
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.modules import guarded
from cnfp_torchrl.training.evaluation import Evaluation, LinearScore, evaluate_seeded
from cnfp_torchrl.training.settings import EvaluationSettings


class IntervalEvaluation:
    """Evaluate the stochastic policy every so many steps of training, in the same episodes.

    It has an environment and random numbers of its own, so that training goes the same way with and
    without it.

    Args:
        make_env: The maker of the environment, without a penalty; called at the first evaluation.
        actor: The actor that is trained.
        settings: The interval, the number of episodes and the seed.
        score: The scale of returns, if the task has one.
    """

    def __init__(
        self,
        make_env: Callable[[], EnvBase],
        actor: SafeProbabilisticTensorDictSequential,
        settings: EvaluationSettings,
        score: LinearScore | None,
    ) -> None:
        self._make_env = make_env
        self._env: EnvBase | None = None
        self._policy = guarded(actor)
        self._settings, self._score = settings, score
        self.history: list[dict[str, Any]] = []
        """The reports of the evaluations so far, each with its ``step``."""

    def run_if_due(self, frames: int, is_last: bool) -> dict[str, Any] | None:
        """Return the report of an evaluation after this many steps, or None where none is due.

        Args:
            frames: The number of environment steps so far.
            is_last: Whether training ends here, after which the policy is the last candidate for
                the best one.

        Raises:
            FloatingPointError: when a return is not finite.
        """
        interval = self._settings.interval
        before = self.history[-1]["step"] if self.history else 0
        is_due = interval is not None and frames // interval > before // interval
        if interval is None or not (is_due or (is_last and frames > before)):
            return None
        with torch.random.fork_rng():
            if self._env is None:
                self._env = self._make_env()
            result = evaluate_seeded(self._env, self._policy, self._settings.at_interval())
        self.history.append({"step": frames, **self._report(result)})
        return self.history[-1]

    def close(self) -> None:
        """Close the environment, which may have processes of its own."""
        if self._env is not None:
            self._env.close()
            self._env = None

    def _report(self, result: Evaluation) -> dict[str, Any]:
        """Return the numbers of a report that make a curve."""
        report = result.report(self._score)
        names = ("return_mean", "return_standard_error", "score", "violations", "episodes")
        return {name: report[name] for name in names}
