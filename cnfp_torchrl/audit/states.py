"""States to audit in: drawn from the observation spec, and what tells them apart."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Bounded, Composite
from torchrl.envs import EnvBase, TransformedEnv

from cnfp_torchrl.envs import StateSetter, observed_entries
from cnfp_torchrl.keys import COST_KEY

_NO_END = 1e30

LARGEST_ENTRY = 64
"""Entries of a state with more numbers, such as pictures, are not written down."""


def bare(env: EnvBase) -> EnvBase:
    """Return an environment without its transforms."""
    return env.base_env if isinstance(env, TransformedEnv) else env


def state_keys(env: EnvBase) -> list[NestedKey]:
    """Return what an environment shows of a state itself, and its transforms do not remove."""
    spec, batch = bare(env).observation_spec, env.batch_size.numel()
    shown = env.observation_spec.keys(include_nested=True, leaves_only=True)
    return [
        key
        for key in spec.keys(include_nested=True, leaves_only=True)
        if key != COST_KEY and spec[key].shape.numel() <= LARGEST_ENTRY * batch and key in shown
    ]


def uniform_states(env: EnvBase, state_setter: StateSetter, count: int) -> TensorDictBase:
    """Draw states ``(count,)`` from the observation spec, as the environment then shows them."""
    found: list[TensorDictBase] = []
    while sum(map(len, found)) < count:
        shown = state_setter(bare(env), _drawn(bare(env).observation_spec))
        if isinstance(env, TransformedEnv):
            shown = env.transform._reset(shown.empty(), shown)
        found.append(shown.reshape(-1))
    return torch.cat(found)[:count]


def _drawn(spec: Composite) -> TensorDictBase:
    """Draw states, uniformly between two ends; TorchRL draws NaN where a component has one end."""
    states: TensorDictBase = spec.rand()
    for key in spec.keys(include_nested=True, leaves_only=True):
        if isinstance(spec[key], Bounded) and spec[key].dtype.is_floating_point:
            states.set(key, _between(spec[key].space.low, spec[key].space.high))
    return states


def _between(low: Tensor, high: Tensor) -> Tensor:
    """Draw uniformly where both ends are finite, else normally around 0 or from the one end."""
    noise = torch.randn_like(low)
    # Some specs write the largest number for no end at all.
    has_low, has_high = (end.abs() < _NO_END for end in (low, high))
    share = torch.rand_like(low)
    inner = torch.where(has_low, low, 0) * (1 - share) + torch.where(has_high, high, 0) * share
    one_end = torch.where(has_low, low + noise.abs(), high - noise.abs())
    return torch.where(has_low & has_high, inner, torch.where(has_low | has_high, one_end, noise))


def before_concatenation(env: EnvBase, states: TensorDictBase) -> TensorDictBase:
    """Return states with the parts of vectors that TorchRL's `CatTensors` has made of them.

    Those that it removes, too, and those that it has written the vector over.
    """
    keys = env.observation_spec.keys(include_nested=True, leaves_only=True)
    parts = states.copy()
    for entry in observed_entries(env, keys):
        for key, value in entry.split(states.get(entry.key)).items():
            parts.set(key, value)
    return parts


def difference(env: EnvBase, expected: TensorDictBase, given: TensorDictBase) -> NestedKey | None:
    """Return a key of the state that differs, of those of `state_keys`, or None.

    What transforms have removed without a trace from what is expected is not compared.
    """
    known = expected.keys(include_nested=True, leaves_only=True)
    for key in filter(known.__contains__, state_keys(env)):
        a, b = expected.get(key).double(), given.get(key).double()
        if not torch.allclose(a, b, rtol=1e-5, atol=1e-6, equal_nan=True):
            return key
    return None
