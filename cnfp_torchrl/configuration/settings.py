"""Validation of settings: one table, for configurations and for classes that they describe."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import fields
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from omegaconf import DictConfig, OmegaConf

if TYPE_CHECKING:  # a module of type stubs, which cannot be imported
    from _typeshed import DataclassInstance


class Expected(NamedTuple):
    """A kind of value that a setting may have.

    Args:
        description: The end of the sentence "expected ...".
        accepts: The test of a value.
    """

    description: str
    accepts: Callable[[Any], bool]


def _is_number(given: Any) -> bool:
    return isinstance(given, Real) and not isinstance(given, bool) and math.isfinite(given)


def _is_whole(given: Any) -> bool:
    return isinstance(given, Integral) and not isinstance(given, bool)


def _devices() -> list[str]:
    """Return the names of the devices that PyTorch can use here."""
    accelerators = [f"cuda:{index}" for index in range(torch.cuda.device_count())]
    return ["cpu", *(["cuda", *accelerators] if accelerators else [])]


def _is_device(given: Any) -> bool:
    return isinstance(given, str) and given in _devices()


def _list_of(accepts: Callable[[Any], bool]) -> Callable[[Any], bool]:
    def is_list(given: Any) -> bool:
        return (
            isinstance(given, Sequence) and not isinstance(given, str) and all(map(accepts, given))
        )

    return is_list


def _or_null(expected: Expected) -> Expected:
    return Expected(f"{expected.description}, or null", lambda x: x is None or expected.accepts(x))


FLAG = Expected("true or false", lambda x: isinstance(x, bool))
COUNT = Expected("a whole number >= 1", lambda x: _is_whole(x) and x >= 1)
WHOLE = Expected("a whole number >= 0", lambda x: _is_whole(x) and x >= 0)
NUMBER = Expected("a finite number", _is_number)
POSITIVE = Expected("a finite number > 0", lambda x: _is_number(x) and x > 0)
NOT_NEGATIVE = Expected("a finite number >= 0", lambda x: _is_number(x) and x >= 0)
DISCOUNT = Expected("a discount in [0, 1)", lambda x: _is_number(x) and 0 <= x < 1)
RATE = Expected("a number in (0, 1]", lambda x: _is_number(x) and 0 < x <= 1)
RADIUS = Expected("a number > 0", lambda x: x == math.inf or POSITIVE.accepts(x))
LOSS_FUNCTION = Expected("'l2', 'smooth_l1' or 'l1'", lambda x: x in ("l2", "smooth_l1", "l1"))
PORT = Expected("a port from 1 to 65535", lambda x: COUNT.accepts(x) and x <= 65535)
ENTROPY = Expected("a finite number or 'auto'", lambda x: x == "auto" or _is_number(x))
COUNTS = Expected("a list of whole numbers >= 1", _list_of(COUNT.accepts))
COSTS = Expected(
    "a finite number >= 0, or a list of them",
    lambda x: NOT_NEGATIVE.accepts(x) or _list_of(NOT_NEGATIVE.accepts)(x),
)
NAMES = Expected("a list of the constraints' names", _list_of(lambda x: isinstance(x, str)))
PAIRS = Expected("a list of pairs such as [[0, 1]]", _list_of(lambda _: True))
DEVICE = Expected(f"a device of this machine: {', '.join(_devices())}", _is_device)

EXPECTED = {
    "seed": WHOLE,
    "threads": COUNT,
    "device": DEVICE,
    "compile": FLAG,
    "batch": COUNT,
    "env.agents": COUNT,
    "env.order": NAMES,
    "env.gamma": DISCOUNT,
    "env.loss_function": LOSS_FUNCTION,
    "env.target_entropy": ENTROPY,
    "env.penalty.penalty": POSITIVE,
    "env.score.zero": NUMBER,
    "env.score.one": NUMBER,
    "flow.max_radius": RADIUS,
    "network.hidden": COUNTS,
    "loss.gamma": DISCOUNT,
    "loss.gamma_cost": DISCOUNT,
    "loss.loss_function": LOSS_FUNCTION,
    "loss.target_entropy": ENTROPY,
    "loss.thresholds": COSTS,
    "loss.lambda_init": POSITIVE,
    "loss.lambda_max": POSITIVE,
    "loss.num_cost_nets": COUNT,
    "loss.lmbda": RATE,
    "loss.clip_epsilon": POSITIVE,
    "loss.entropy_coeff": NOT_NEGATIVE,
    "loss.policy_noise": NOT_NEGATIVE,
    "loss.noise_clip": NOT_NEGATIVE,
    "network.actor.noise": POSITIVE,
    "network.actor.reach": POSITIVE,
    "algorithm.actor_every": COUNT,
    "algorithm.epochs": COUNT,
    "algorithm.minibatch": COUNT,
    "algorithm.max_grad_norm": POSITIVE,
    "target.tau": RATE,
    "optim.lr": POSITIVE,
    "collector.total_frames": COUNT,
    "collector.frames_per_batch": COUNT,
    "replay_buffer.batch_size": COUNT,
    "replay_buffer.storage.max_size": COUNT,
    "training.warmup_frames": WHOLE,
    "training.update_ratio": NOT_NEGATIVE,
    "training.log_interval": COUNT,
    "training.constraint_bytes": WHOLE,
    "checkpoint.interval": _or_null(COUNT),
    "checkpoint.keep": COUNT,
    "checkpoint.keep_last": FLAG,
    "evaluation.episodes": COUNT,
    "evaluation.seed": WHOLE,
    "evaluation.max_steps": COUNT,
    "evaluation.interval": _or_null(COUNT),
    "evaluation.interval_episodes": COUNT,
    "audit.states": COUNT,
    "audit.actions": COUNT,
    "audit.steps": COUNT,
    "audit.uniform": FLAG,
    "audit.examples": WHOLE,
    "audit.strict": FLAG,
    "audit.seed": WHOLE,
    "visual.every": COUNT,
    "visual.episodes": COUNT,
    "visual.samples": COUNT,
    "visual.render_every": WHOLE,
    "visual.deterministic": FLAG,
    "visual.projections": _or_null(PAIRS),
    "visual.viewer.port": _or_null(PORT),
    "visual.viewer.web_port": PORT,
}
"""The kind of value of each setting, by its dotted name in a configuration."""


def require_setting(name: str, given: object) -> None:
    """Refuse a value that a setting of the table may not have.

    Args:
        name: The setting's name, as in `EXPECTED`.
        given: The setting's value.

    Raises:
        ValueError: naming the setting, what was expected and what was given.
    """
    expected = EXPECTED[name]
    if not expected.accepts(given):
        raise ValueError(f"{name}: expected {expected.description}, given {given!r}")


def require_fields(section: str, given: DataclassInstance) -> None:
    """Refuse a dataclass with a field that the setting of its name may not have.

    Args:
        section: The section of a configuration that describes the dataclass, such as ``training``.
        given: The dataclass; every field is in the table.

    Raises:
        ValueError: naming the setting, what was expected and what was given.
    """
    for field in fields(given):
        require_setting(f"{section}.{field.name}", getattr(given, field.name))


def require_settings(config: DictConfig) -> None:
    """Refuse a configuration with a setting of the wrong kind, before any work starts.

    Settings that it does not have are passed over: other collectors, losses and optimizers have
    others. A whole number may be written with an exponent, as in 1e4, and is one afterwards.

    Raises:
        ValueError: naming the setting, what was expected and what was given.
    """
    absent = object()
    for name in EXPECTED:
        given = OmegaConf.select(config, name, default=absent)
        if isinstance(given, float) and given.is_integer() and EXPECTED[name].accepts(int(given)):
            OmegaConf.update(config, name, int(given))
        elif given is not absent:
            require_setting(name, given)
