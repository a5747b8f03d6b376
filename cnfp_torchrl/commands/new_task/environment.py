"""The environment: point masses in a plane, pushed towards a goal; all agents in one batch."""

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from cnfp_torchrl.envs import Component, TaskView

from .judge import LIMIT, too_fast

STEP = 0.05  # s, for which an action is held
STEPS = 200  # after which an episode is cut off
GOAL = (0.8, 0.8)  # m; starts are drawn from [-1, 0]²


class PointMass(EnvBase):
    """Agents that start at rest, accelerated by their actions, each by at most 1 m/s² an axis.

    Args:
        batch_size: The shape of the batch of agents.
        device: The device to compute on.
    """

    # The columns of `cost`; the geometry of the configuration has the same names.
    constraint_names = ("speed",)

    state: Tensor
    steps: Tensor

    def __init__(
        self, batch_size: Sequence[int] = (), device: torch.device | str | None = None
    ) -> None:
        super().__init__(batch_size=torch.Size(batch_size), device=device)
        batch = self.batch_size
        self.register_buffer("state", torch.zeros(*batch, 4))  # x, y and their rates
        self.register_buffer("steps", torch.zeros(*batch, 1, dtype=torch.int64))
        farthest = 1 + LIMIT * STEP * STEPS
        most = torch.tensor([farthest, farthest, LIMIT, LIMIT]).expand(*batch, 4)
        self.observation_spec = Composite(
            observation=Bounded(-most, most), cost=Bounded(0, 1, (*batch, 1)), shape=batch
        )
        self.action_spec = Bounded(-1, 1, (*batch, 2))
        self.reward_spec = Unbounded((*batch, 1))
        flag = Binary(1, (*batch, 1), dtype=torch.bool)
        self.full_done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=batch
        )
        if device is not None:
            self.to(device)
        self.set_seed(int(torch.randint(2**31, ())))

    def task_view(self, env: EnvBase) -> TaskView:
        """Return names and units, and what puts the agents into states of the audit's choice."""
        return PointMassView()

    def _set_seed(self, seed: int | None) -> None:
        self.generator = torch.Generator().manual_seed(seed or 0)

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        start = torch.zeros(*self.batch_size, 4)
        start[..., :2] = -torch.rand(*self.batch_size, 2, generator=self.generator)
        ended = None if tensordict is None else tensordict.get("_reset", None)
        if ended is None:
            ended = torch.ones_like(self.steps, dtype=torch.bool)
        self.state = torch.where(ended, start.to(self.state.device), self.state)
        self.steps = self.steps.masked_fill(ended, 0)
        return self._shown()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        position, velocity = self.state.chunk(2, -1)
        velocity = velocity + STEP * tensordict["action"]
        self.state = torch.cat([position + STEP * velocity, velocity], -1)
        self.steps = self.steps + 1
        shown = self._shown()
        return shown.set("reward", -self._distance())

    def _distance(self) -> Tensor:
        position = self.state[..., :2]
        return torch.linalg.vector_norm(position - position.new_tensor(GOAL), dim=-1, keepdim=True)

    def _shown(self) -> TensorDict:
        # Terminated is where the task is over, and nothing is to be had afterwards; truncated is
        # where it would go on, so that the return still counts what would have come.
        terminated, truncated = self._distance() < 0.05, self.steps >= STEPS
        return TensorDict(
            {
                "observation": self.state,
                "cost": too_fast(self.state).unsqueeze(-1).float(),
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
            },
            self.batch_size,
            device=self.device,
        )


class PointMassView(TaskView):
    """The names and units of the task's numbers, and its state setter."""

    observation_components = (
        Component("x", "m"),
        Component("y", "m"),
        Component("x velocity", "m/s"),
        Component("y velocity", "m/s"),
    )
    action_components = (
        Component("x acceleration", "m/s²"),
        Component("y acceleration", "m/s²"),
    )

    @staticmethod
    def state_setter(env: EnvBase, states: TensorDictBase) -> TensorDictBase:
        """Put the agents into given states, and return what they then show."""
        env.state = states["observation"].clone()
        env.steps = torch.zeros_like(env.steps)
        return env._shown().select("observation")
