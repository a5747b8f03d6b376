"""States to audit in: how an environment is put into them, and what tells them apart."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase, TransformedEnv

from cnfp_torchrl.keys import COST_KEY
from cnfp_torchrl.tasks.point_nav import PointNavEnv
from cnfp_torchrl.tasks.point_nav.geometry import read_observation

Place = Callable[[EnvBase, TensorDictBase], TensorDictBase]
"""``(env, states) -> shown``: put an environment into states, and return what it then shows.

It is given the environment without its transforms, and states of its batch size with the entries
of its observation spec: such as it showed before, and drawn ones. What it returns needs no more
than these entries, read from the environment anew: it is checked that they are those of the states.
"""

LARGEST_ENTRY = 64
"""Entries of a state with more numbers, such as pictures, are not written down."""


def place_point_nav(env: EnvBase, states: TensorDictBase) -> TensorDictBase:
    """Put point navigation into the states that observations show."""
    position, battery = read_observation(states, "observation")
    return env.reset(position=position, battery=battery, goal=states["observation"][..., 3:])


def known_place(env: EnvBase) -> Place | None:
    """Return how to put an environment of this package into a chosen state, None for others."""
    return place_point_nav if isinstance(bare(env), PointNavEnv) else None


def bare(env: EnvBase) -> EnvBase:
    """Return an environment without its transforms."""
    return env.base_env if isinstance(env, TransformedEnv) else env


def state_keys(env: EnvBase) -> list[NestedKey]:
    """Return what the environment itself, without transforms, shows of a state."""
    spec, batch = bare(env).observation_spec, env.batch_size.numel()
    return [
        key
        for key in spec.keys(include_nested=True, leaves_only=True)
        if key != COST_KEY and spec[key].shape.numel() <= LARGEST_ENTRY * batch
    ]


def uniform_states(env: EnvBase, place: Place, count: int) -> TensorDictBase:
    """Return states ``(count,)`` drawn from the observation spec, as the environment shows them."""
    found: list[TensorDictBase] = []
    while sum(map(len, found)) < count:
        shown = place(bare(env), bare(env).observation_spec.rand())
        if isinstance(env, TransformedEnv):
            shown = env.transform._reset(shown.empty(), shown)
        found.append(shown.reshape(-1))
    return torch.cat(found)[:count]


def difference(env: EnvBase, expected: TensorDictBase, given: TensorDictBase) -> NestedKey | None:
    """Return a key of the state that differs, or None."""
    for key in state_keys(env):
        a, b = expected.get(key).double(), given.get(key).double()
        if not torch.allclose(a, b, rtol=1e-5, atol=1e-6, equal_nan=True):
            return key
    return None
