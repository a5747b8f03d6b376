"""An environment whose constraint can be had in some states, and cannot in others."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv

from cnfp_torchrl.envs import GeometryTransform, constrain_env
from cnfp_torchrl.geometry import ConstraintSet, HalfSpaces, VisibleRegion

HOLDS, MISSED = 0.5, -3.0
"""A limit that actions of the unit box can keep, and one that they miss by 2 at the least."""


class Walls(EnvBase):
    """Shows a limit of each agent's first action component, the next one at each step.

    Args:
        limits: The limits in turn; agent i begins with the i-th.
        agents: The batch size.
        unit: The unit of actions and limits.
        judged: Names of the constraints with a column of ``cost``; none publishes no cost.
        length: Steps until an episode ends.
    """

    def __init__(
        self,
        limits: Sequence[float] = (HOLDS, MISSED),
        agents: int = 8,
        *,
        unit: float = 1.0,
        judged: Sequence[str] = ("wall",),
        length: int = 10,
    ) -> None:
        super().__init__(batch_size=[agents])
        self.limits, self.unit, self.length = torch.tensor(limits), unit, length
        self.constraint_names = tuple(judged)
        entries: dict[str, Any] = {"observation": Unbounded([agents, 1])}
        if judged:
            entries["cost"] = Unbounded([agents, len(judged)])
        self.observation_spec = Composite(entries, shape=[agents])
        self.action_spec = Bounded(-unit, unit, [agents, 2])
        self.reward_spec = Unbounded([agents, 1])
        self.done_spec = Binary(1, [agents, 1], dtype=torch.bool)
        self.time = 0

    def _shown(self, cost: Tensor) -> TensorDict:
        at = (torch.arange(*self.batch_size) + self.time) % len(self.limits)
        shown = {"observation": self.limits[at].unsqueeze(-1)}
        if self.constraint_names:
            shown["cost"] = cost.unsqueeze(-1).expand(-1, len(self.constraint_names)).clone()
        return TensorDict(shown, self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDict:
        self.time = 0
        return self._shown(torch.zeros(self.batch_size))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action, limit = tensordict["action"][..., 0], tensordict["observation"][..., 0]
        self.time += 1
        done = torch.full((*self.batch_size, 1), self.time >= self.length)
        reward = (action / self.unit).unsqueeze(-1)
        return self._shown((action > limit * self.unit).float()).update(
            {"reward": reward, "done": done}
        )

    def _set_seed(self, seed: int | None) -> None:
        return


class Wall(GeometryTransform):
    """First components of at most the limit that the state shows.

    Args:
        name: The constraint's name.
        unit: The unit of actions and limits.
    """

    def __init__(self, name: str = "wall", unit: float = 1.0) -> None:
        super().__init__(name)
        self.unit = unit

    def constraint_set(self, tensordict: TensorDictBase) -> ConstraintSet:
        limit = tensordict["observation"]
        return HalfSpaces(torch.tensor([[1.0, 0.0]]).expand(*limit.shape, 2), limit * self.unit)


class Window(Wall):
    """The same of a family that cannot be widened: where it cannot be had it is dropped."""

    def constraint_set(self, tensordict: TensorDictBase) -> ConstraintSet:
        limit = tensordict["observation"][..., 0]
        hidden = torch.tensor([[-0.1, -0.1], [0.1, 0.1]]).expand(*limit.shape, 1, 2, 2)
        # Before the rectangle, or in it: there nothing is visible.
        position = torch.where(limit > 0, -5.0, 0.0).unsqueeze(-1).expand(*limit.shape, 2)
        return VisibleRegion(position, hidden, torch.ones_like(limit))


class Told(GeometryTransform):
    """The sets that a function of the state returns."""

    def __init__(
        self, publish: Callable[[TensorDictBase], Any], name: str = "told", **options: Any
    ) -> None:
        super().__init__(name, **options)
        self.answer = publish

    def constraint_set(self, tensordict: TensorDictBase) -> Any:
        return self.answer(tensordict)


def walls(base: EnvBase, *geometries: GeometryTransform) -> TransformedEnv:
    """Return the environment with its constraints, the wall alone unless others are given."""
    return constrain_env(base, *(geometries or (Wall(),)))
