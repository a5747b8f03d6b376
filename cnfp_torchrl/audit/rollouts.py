"""Rollouts that an audit takes its states from, with copies of environments on the way."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cnfp_torchrl.audit.lookahead import StepReader
from cnfp_torchrl.audit.states import bare, difference

Policy = Callable[[TensorDictBase], TensorDictBase]
"""Any TorchRL policy."""


class Rollouts(NamedTuple):
    """Steps of a policy, ``(steps, agents)``."""

    states: TensorDictBase
    """With the action taken; without what it led to."""
    violated: Tensor
    """By indicator, bool ``(steps, agents, I)``."""
    ended: Tensor
    """Whether the episode ended with the step, bool ``(steps, agents)``."""
    copies: list[tuple[EnvBase, TensorDictBase]]
    """Environments in some of the states, where they were asked for."""


def roll_out(
    env: EnvBase, policy: Policy, reader: StepReader, *, steps: int, copies: int = 0
) -> Rollouts:
    """Let a policy act, and keep every state.

    Args:
        env: The environment, which is reset first.
        policy: The policy.
        reader: What reads indicators and flags.
        steps: The number of steps, over episodes.
        copies: The number of copies of the whole environment, at times drawn at random.

    Raises:
        TypeError: when copies are asked for and the environment cannot be copied with its state.
    """
    when = set(torch.randperm(steps)[:copies].tolist())
    size = env.batch_size.numel()
    kept: list[tuple[TensorDictBase, Tensor, Tensor]] = []
    copied: list[tuple[EnvBase, TensorDictBase]] = []
    with set_exploration_type(ExplorationType.RANDOM):
        state = env.reset()
        for step in range(steps):
            acting = policy(state)
            before, twin = acting.clone(), _copy(env) if step in when else None
            noise = torch.get_rng_state()
            transition, following = env.step_and_maybe_reset(acting)
            if twin is not None:
                _refuse_unfaithful(env, twin, before, transition, noise)
                copied.append((twin, before))
            outcome = transition.get("next")
            violated = reader.violated(transition, outcome).reshape(size, -1)
            ended = outcome.get("done").reshape(size, -1).any(-1)
            kept.append((transition.exclude("next").reshape(-1), violated, ended))
            state = following
    states, violated, ended = (torch.stack(list(x)) for x in zip(*kept, strict=True))
    return Rollouts(states, violated, ended, copied)


def _copy(env: EnvBase) -> EnvBase:
    try:
        return copy.deepcopy(env)
    except Exception as error:
        raise TypeError(f"{_expected(env)}, but copying fails: {error}; {_REMEDY}") from error


def _refuse_unfaithful(
    env: EnvBase, twin: EnvBase, before: TensorDictBase, transition: TensorDictBase, noise: Tensor
) -> None:
    """Refuse a copy that does not do what its original did: some start afresh (EzPickle)."""
    with torch.random.fork_rng(devices=[]):
        torch.set_rng_state(noise)
        repeated = copy.deepcopy(twin).step(before.clone())
    if (key := difference(env, transition.get("next"), repeated.get("next"))) is not None:
        raise TypeError(f"{_expected(env)}, but its copy steps to another {key!r}; {_REMEDY}")


def _expected(env: EnvBase) -> str:
    name = type(bare(env)).__name__
    return f"env: expected one that can be copied, to try many actions in one state, given {name}"


_REMEDY = (
    "give a state_setter (in a configuration env.state_setter), a function that puts the "
    "environment into given states, see docs/own_environment.md"
)
