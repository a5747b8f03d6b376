"""A TorchRL environment that shows what one of Gymnasium has observed."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase


class ObservedEnv(EnvBase):
    """Show the observations that it is given, so that TorchRL's transforms can read them.

    Entries are named as `torchrl.envs.GymEnv` names them: those of a dictionary by their names, any
    other observation ``observation``. It is reset for each observation, and never stepped.

    Args:
        observation_space: The space of one environment's observations.
        action_space: The space of one environment's actions.
        batch_size: The number of environments, ``(n,)``, or ``()`` for a single one.

    Raises:
        TypeError: when the actions are no box of vectors, or an observation is no array.
    """

    def __init__(
        self,
        observation_space: gymnasium.Space[Any],
        action_space: gymnasium.Space[Any],
        batch_size: tuple[int, ...] = (),
    ) -> None:
        if not isinstance(action_space, spaces.Box) or len(action_space.shape) != 1:
            raise TypeError(
                f"action_space: expected a Box of vectors, given {action_space}; constraints are "
                "of continuous actions"
            )
        super().__init__(batch_size=torch.Size(batch_size))
        entries = _entries(observation_space)
        self.observation_spec = Composite(
            {name: _spec(name, space, batch_size) for name, space in entries.items()},
            shape=self.batch_size,
        )
        low, high = (torch.from_numpy(b.copy()) for b in (action_space.low, action_space.high))
        shape = (*batch_size, *low.shape)
        self.action_spec = Bounded(low.expand(shape), high.expand(shape), shape, dtype=low.dtype)
        self.reward_spec = Unbounded((*batch_size, 1))
        self.shown = self.observation_spec.zero()

    def show(self, observation: Any) -> None:
        """Keep a copy of an observation, to be returned by the next reset."""
        named = observation if isinstance(observation, dict) else {"observation": observation}
        self.shown = TensorDict(_tensors(named), batch_size=self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        return self.shown

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise NotImplementedError("the environment of Gymnasium is stepped instead")

    def _set_seed(self, seed: int | None) -> None:
        """Do nothing: there is no randomness."""


def _entries(space: gymnasium.Space[Any]) -> dict[str, gymnasium.Space[Any]]:
    return dict(space.spaces) if isinstance(space, spaces.Dict) else {"observation": space}


def _spec(name: str, space: gymnasium.Space[Any], batch: tuple[int, ...]) -> TensorSpec:
    if isinstance(space, spaces.Dict):
        parts = {key: _spec(key, part, batch) for key, part in space.spaces.items()}
        return Composite(parts, shape=torch.Size(batch))
    if space.shape is None or space.dtype is None:
        raise TypeError(
            f"observation_space '{name}': expected a space of arrays or a dictionary of such, "
            f"given {space}; leave it out with a gymnasium.wrappers.FilterObservation"
        )
    dtype = torch.from_numpy(np.zeros((), space.dtype)).dtype
    return Unbounded((*batch, *space.shape), dtype=dtype)


def _tensors(named: dict[str, Any]) -> dict[str, Any]:
    # Copies: vector environments may write the next observation into the same array.
    return {
        name: _tensors(value) if isinstance(value, dict) else torch.from_numpy(np.array(value))
        for name, value in named.items()
    }
