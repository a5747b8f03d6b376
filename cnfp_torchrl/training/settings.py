"""Settings of training and evaluation, refused when they make no sense."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf


class Expected(NamedTuple):
    """What a setting has to be.

    Args:
        words: to complete "expected ...".
        fits: tells whether a value is that.
    """

    words: str
    fits: Callable[[Any], bool]

    def require(self, name: str, given: object) -> None:
        """Refuse anything else.

        Raises:
            ValueError: naming the setting, what was expected and what was given.
        """
        if not self.fits(given):
            raise ValueError(f"{name}: expected {self.words}, given {given!r}")


def _is_number(given: Any) -> bool:
    return isinstance(given, Real) and not isinstance(given, bool) and math.isfinite(given)


def _is_whole(given: Any) -> bool:
    return isinstance(given, Integral) and not isinstance(given, bool)


def _is_list(given: Any) -> bool:
    return isinstance(given, Sequence) and not isinstance(given, str)


FLAG = Expected("true or false", lambda x: isinstance(x, bool))
COUNT = Expected("a whole number >= 1", lambda x: _is_whole(x) and x >= 1)
WHOLE = Expected("a whole number >= 0", lambda x: _is_whole(x) and x >= 0)
NUMBER = Expected("a finite number", _is_number)
POSITIVE = Expected("a finite number > 0", lambda x: _is_number(x) and x > 0)
NOT_NEGATIVE = Expected("a finite number >= 0", lambda x: _is_number(x) and x >= 0)
DISCOUNT = Expected("a discount in [0, 1)", lambda x: _is_number(x) and 0 <= x < 1)
RATE = Expected("a number in (0, 1]", lambda x: _is_number(x) and 0 < x <= 1)
RADIUS = Expected("a number > 0", lambda x: x == math.inf or POSITIVE.fits(x))
PORT = Expected("a port from 1 to 65535", lambda x: COUNT.fits(x) and x <= 65535)
ENTROPY = Expected("a finite number or 'auto'", lambda x: x == "auto" or _is_number(x))
COUNTS = Expected("a list of whole numbers >= 1", lambda x: _is_list(x) and all(map(COUNT.fits, x)))
COSTS = Expected(
    "a list of finite numbers >= 0", lambda x: _is_list(x) and all(map(NOT_NEGATIVE.fits, x))
)
NAMES = Expected(
    "a list of names such as [battery, obstacle]",
    lambda x: _is_list(x) and all(isinstance(each, str) for each in x),
)
PAIRS = Expected("a list of pairs such as [[0, 1]], or null", lambda x: x is None or _is_list(x))
FREE_OR_PORT = Expected(f"{PORT.words}, or null", lambda x: x is None or PORT.fits(x))

_EXPECTED = {
    "seed": WHOLE,
    "threads": COUNT,
    "compile": FLAG,
    "batch": COUNT,
    "env.agents": COUNT,
    "env.penalty.penalty": POSITIVE,
    "flow.order": NAMES,
    "flow.combine.max_radius": RADIUS,
    "network.hidden": COUNTS,
    "loss.gamma": DISCOUNT,
    "loss.gamma_cost": DISCOUNT,
    "loss.target_entropy": ENTROPY,
    "loss.thresholds": COSTS,
    "loss.lambda_init": POSITIVE,
    "loss.lambda_max": POSITIVE,
    "loss.num_cost_nets": COUNT,
    "target.tau": RATE,
    "optim.lr": POSITIVE,
    "collector.total_frames": COUNT,
    "collector.frames_per_batch": COUNT,
    "replay_buffer.batch_size": COUNT,
    "replay_buffer.storage.max_size": COUNT,
    "visual.every": COUNT,
    "visual.episodes": COUNT,
    "visual.samples": COUNT,
    "visual.deterministic": FLAG,
    "visual.projections": PAIRS,
    "visual.viewer.port": FREE_OR_PORT,
    "visual.viewer.web_port": PORT,
}


def require_settings(config: DictConfig) -> None:
    """Refuse settings of a configuration that what they are for would take, and fail with later.

    Keys that it does not have are passed over: other collectors, losses and optimizers have others.

    Raises:
        ValueError: naming the setting, what was expected and what was given.
    """
    absent = object()
    for name, expected in _EXPECTED.items():
        given = OmegaConf.select(config, name, default=absent)
        if given is not absent:
            expected.require(name, given)


def require_frames(config: DictConfig) -> None:
    """Refuse a training run that ends within its first batch or its warm-up.

    Raises:
        ValueError: naming the setting, what was expected and what was given.
    """
    total = config.collector.total_frames
    for name in ("collector.frames_per_batch", "training.warmup_frames"):
        given = OmegaConf.select(config, name)
        if given > total:
            raise ValueError(
                f"{name}: expected at most collector.total_frames = {total}, given {given}; lower "
                "it, or train for longer"
            )


@dataclass(frozen=True)
class TrainingSettings:
    """How data, updates and log entries follow each other.

    Args:
        warmup_frames: environment steps with safe random actions, before the actor acts and learns.
        update_ratio: updates for each environment step.
        log_interval: environment steps between two entries of the log.
        constraint_bytes: how much of a transition may be stored for constraints; sets that do not
            fit are computed anew at sampling, which takes a little time.

    Raises:
        ValueError: naming the setting, what was expected and what was given.
    """

    warmup_frames: int = 1000
    update_ratio: float = 0.5
    log_interval: int = 400
    constraint_bytes: int = 64

    def __post_init__(self) -> None:
        WHOLE.require("training.warmup_frames", self.warmup_frames)
        NOT_NEGATIVE.require("training.update_ratio", self.update_ratio)
        COUNT.require("training.log_interval", self.log_interval)
        WHOLE.require("training.constraint_bytes", self.constraint_bytes)


@dataclass(frozen=True)
class EvaluationSettings:
    """How a policy is judged.

    Args:
        episodes: whole episodes for each policy.
        seed: of the environment's starts and goals, the same for all policies.

    Raises:
        ValueError: naming the setting, what was expected and what was given.
    """

    episodes: int = 400
    seed: int = 1000

    def __post_init__(self) -> None:
        COUNT.require("evaluation.episodes", self.episodes)
        WHOLE.require("evaluation.seed", self.seed)
