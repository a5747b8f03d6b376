"""A test of an exported policy: how much of it is certified, whether that holds, how fast it is."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.deploy.export import Run
from cnfp_torchrl.deploy.policy import DeployedPolicy
from cnfp_torchrl.modules import SafeRandomPolicy

CHUNK = 8192
"""The number of states that are tested at once."""


@torch.no_grad()
def observed_states(
    policy: DeployedPolicy, env: EnvBase, actor: SafeProbabilisticTensorDictSequential, count: int
) -> tuple[Tensor, ...]:
    """Return inputs of a policy from states that two policies visit, each half of them.

    Args:
        policy: The policy whose inputs are collected.
        env: The environment; it is reset.
        actor: The constrained actor; the other policy is the `SafeRandomPolicy` of it.
        count: The number of states.
    """
    steps = -(-count // (2 * max(env.numel(), 1)))
    rollouts: list[Any] = [
        env.rollout(steps, policy, break_when_any_done=False).reshape(-1)
        for policy in (SafeRandomPolicy(actor), actor)
    ]
    visited: Any = torch.cat(rollouts)
    chosen = visited[torch.randperm(len(visited))[:count]]
    observed: dict[NestedKey, Tensor] = {}
    for entry in policy.entries:
        observed |= entry.split(chosen.get(entry.key))
    return tuple(observed[key].contiguous() for key in policy.input_keys)


@torch.no_grad()
def self_test(policy: DeployedPolicy, run: Run, states: Sequence[Tensor]) -> dict[str, Any]:
    """Run an exported policy in some states, and compare it with what is allowed there.

    Args:
        policy: The policy in eager mode, whose sets decide.
        run: The exported policy.
        states: The inputs without noise, ``(n, *event)`` each; noise is drawn.

    Returns:
        Counts: ``states``, ``certified``, ``violations`` (certified actions outside a set or the
        action bounds, with zero tolerance in float64), ``fallback_out_of_bounds``,
        ``certified_otherwise_in_eager``, and ``largest_difference`` from eager mode's actions where
        both are certified, beside ``largest_change_in_the_last_bit``: by how much these change when
        the inputs do in their last bit. Where sets are narrow both are large, for the same reason.
    """
    counts = dict.fromkeys(
        (
            "states",
            "certified",
            "violations",
            "fallback_out_of_bounds",
            "certified_otherwise_in_eager",
        ),
        0,
    )
    largest = changed = 0.0
    for inputs in zip(*(value.split(CHUNK) for value in states), strict=True):
        given = with_noise(policy, inputs)
        action, certified = run(*given)
        eager, eager_certified = policy(*given)
        bounds = policy.bounds.on(None)
        within = bounds.contains(action)
        inside = within.clone()
        for constraint_set in policy.sets(policy.states(*given)):
            inside &= constraint_set.contains(action)
        both = certified & eager_certified
        if bool(both.any()):
            largest = max(largest, float((action - eager)[both].abs().amax()))
            nudged, still_certified = policy(*map(_next, given))
            if bool((both := both & still_certified).any()):
                changed = max(changed, float((nudged - eager)[both].abs().amax()))
        for name, mask in {
            "states": torch.ones_like(certified),
            "certified": certified,
            "violations": certified & ~inside,
            "fallback_out_of_bounds": ~certified & ~within,
            "certified_otherwise_in_eager": certified != eager_certified,
        }.items():
            counts[name] += int(mask.sum())
    return {
        **counts,
        "largest_difference": largest,
        "largest_change_in_the_last_bit": changed,
    }


def _next(value: Tensor) -> Tensor:
    """Return the next larger numbers, where they are floating."""
    return value.nextafter(value.new_full((), torch.inf)) if value.is_floating_point() else value


def with_noise(policy: DeployedPolicy, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Return inputs with noise behind them, if the policy takes any."""
    if not policy.stochastic:
        return tuple(inputs)
    noise = torch.randn(len(inputs[0]), *policy.noise_shape, dtype=policy.action_dtype)
    return (*inputs, noise)


@torch.no_grad()
def latencies(
    runs: Mapping[str, Run],
    inputs: Sequence[Tensor],
    rounds: int = 200,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Return the median time of one call with one state, in milliseconds, by turns of all runs.

    Args:
        runs: Policies by their names.
        inputs: The inputs of one state, ``(1, *event)`` each.
        rounds: The number of calls of each.
        clock: The clock, in seconds; `time.thread_time` on a machine that others load.
    """
    taken: dict[str, list[float]] = {name: [] for name in runs}
    for turn in range(rounds + 10):
        for name, run in runs.items():
            started = clock()
            run(*inputs)
            if turn >= 10:
                taken[name].append(1e3 * (clock() - started))
    return {name: statistics.median(times) for name, times in taken.items()}
