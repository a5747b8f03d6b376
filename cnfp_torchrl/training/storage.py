"""The replay buffer of a run: what it stores of a transition, and what it computes at sampling."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict.utils import NestedKey
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import EnvBase

from cnfp_torchrl.envs import (
    PackedStates,
    SampledGeometry,
    amounts_keys,
    constraints_to_sample,
)
from cnfp_torchrl.keys import ACTION_KEY, CONSTRAINTS_KEY, REWARD_KEY


def prepare_buffer(
    buffer: TensorDictReplayBuffer,
    env: EnvBase,
    state_keys: Sequence[NestedKey],
    *,
    other_keys: Sequence[NestedKey] = (),
    constraint_bytes: int,
) -> list[NestedKey]:
    """Let a buffer store little of constraints; return the keys of transitions to extend it with.

    What the actor reads is stored once a state (`PackedStates`), besides sets that are too large:
    those are computed at sampling (`SampledGeometry`). Relaxations, which are zero in most states,
    are stored for the states only in which they are not. Without constraints nothing is done.

    Args:
        buffer: An empty buffer that overwrites the oldest transitions first.
        env: The environment that publishes what is to be stored.
        state_keys: Entries of a state that the actor reads.
        other_keys: Entries that the loss reads besides states, action, reward and ends.
        constraint_bytes: The memory that a stored transition may take for constraints.
    """
    computed = SampledGeometry(env, constraints_to_sample(env, state_keys, constraint_bytes))
    stored = [key for key in state_keys if key not in computed.field_keys]
    state = list(dict.fromkeys([*computed.state_keys, *stored]))
    if any(isinstance(key, tuple) and key[0] == CONSTRAINTS_KEY for key in state):
        rare = amounts_keys(env)
        buffer.append_transform(PackedStates(state, buffer.storage.max_size, rare))
    if computed.field_keys:
        buffer.append_transform(computed)
    outcome = [("next", key) for key in (*state, REWARD_KEY, "done", "terminated")]
    return [*state, ACTION_KEY, *outcome, *other_keys]
