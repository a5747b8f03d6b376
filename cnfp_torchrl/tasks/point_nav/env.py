"""Point navigation as a native, batched TorchRL environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from cnfp_torchrl.envs import TaskView
from cnfp_torchrl.keys import refuse_non_finite
from cnfp_torchrl.tasks.point_nav.dynamics import (
    CONSTRAINT_NAMES,
    Collision,
    PointNavDynamics,
    State,
)
from cnfp_torchrl.tasks.point_nav.layout import EPISODE_STEPS, Layout
from cnfp_torchrl.tasks.point_nav.task_view import PointNavView


class PointNavEnv(EnvBase):
    """Navigate to goals without touching obstacles or letting the battery run low.

    The task of the paper's section Experiments, with the sizes of `Layout`. Episodes have no
    terminal state and are truncated. A reset to a chosen state, for audits and pictures:
    ``env.reset(position=..., battery=..., goal=...)``, any of the three, broadcast over the batch;
    whichever is left out is drawn.

    Keys, with ``*b`` the batch size:
        - ``observation`` float32 ``(*b, 5)``: x, y, battery / 100, goal x, goal y,
        - ``action`` float32 ``(*b, 2)`` in [-1, 1]; outside is clipped,
        - ``reward`` float32 ``(*b, 1)``,
        - ``cost`` float32 ``(*b, 2)``: the indicators as 0 or 1, in the order of
          `constraint_names`; zeros after a reset,
        - ``done``, ``terminated`` (never), ``truncated`` bool ``(*b, 1)``.

    Args:
        batch_size: The shape of the batch of agents, which are independent of each other.
        layout: The map; None takes the reference task.
        collision: The effect of a collision, which is counted: with ``pass`` the agent goes on
            through an obstacle and is clipped at the walls, with ``block`` it stays where it is.
        max_steps: The length at which an episode is truncated.
        device: The device to compute on.
        seed: The seed of starts and goals; None takes one from torch's global generator.

    Raises:
        ValueError: for a bad argument, a start state outside the arena, and for an action with NaN
            (which every comparison of an indicator would otherwise call safe).
    """

    constraint_names: tuple[str, ...] = CONSTRAINT_NAMES

    position: Tensor
    battery: Tensor
    goal: Tensor
    steps: Tensor
    _generator: torch.Generator

    def __init__(
        self,
        batch_size: Sequence[int] = (),
        *,
        layout: Layout | None = None,
        collision: Collision = "pass",
        max_steps: int = EPISODE_STEPS,
        device: torch.device | str | None = None,
        seed: int | None = None,
    ) -> None:
        if isinstance(max_steps, bool) or not isinstance(max_steps, int) or max_steps < 1:
            raise ValueError(f"max_steps: expected a whole number >= 1, given {max_steps!r}")
        if any(size < 1 for size in batch_size):
            raise ValueError(f"batch_size: expected sizes >= 1, given {tuple(batch_size)}")
        super().__init__(device=device, batch_size=torch.Size(batch_size))
        self.dynamics = PointNavDynamics(layout, collision)
        self.max_steps = max_steps
        self.dynamics.to(self._torch_device)
        self._make_specs()
        for name, width, dtype in (
            ("position", (2,), torch.float32),
            ("battery", (), torch.int64),
            ("goal", (2,), torch.float32),
            ("steps", (), torch.int64),
        ):
            value = torch.zeros((*self.batch_size, *width), dtype=dtype, device=self._torch_device)
            self.register_buffer(name, value)
        self.set_seed(seed)
        self._enter(self.dynamics.sample(self.batch_size, self._generator))

    @property
    def layout(self) -> Layout:
        """The map."""
        return self.dynamics.layout

    @property
    def state(self) -> State:
        """The current state; the tensors are never changed in place."""
        return State(self.position, self.battery, self.goal)

    def task_view(self, env: EnvBase) -> TaskView:
        """Return what this task shows of itself; ``env`` is this one with all its transforms."""
        return PointNavView(self.layout, env)

    def to(self, device: torch.device | str) -> PointNavEnv:
        """Move the environment; the random numbers of another device differ."""
        super().to(device)
        if self._generator.device.type != self._torch_device.type:
            seed = self._generator.initial_seed()
            self._generator = torch.Generator(self._torch_device).manual_seed(seed)
        return self

    @property
    def _torch_device(self) -> torch.device:
        return torch.device("cpu") if self.device is None else self.device

    def _make_specs(self) -> None:
        batch, device, wall = self.batch_size, self._torch_device, self.layout.wall
        numbers: dict[str, Any] = {"device": device, "dtype": torch.float32}
        low = torch.tensor([-wall, -wall, 0.0, -wall, -wall], **numbers).expand(*batch, 5)
        high = torch.tensor([wall, wall, 1.0, wall, wall], **numbers).expand(*batch, 5)
        self.observation_spec = Composite(
            observation=Bounded(low, high, **numbers),
            cost=Bounded(0.0, 1.0, (*batch, len(CONSTRAINT_NAMES)), **numbers),
            shape=batch,
        )
        self.action_spec = Bounded(-1.0, 1.0, (*batch, 2), **numbers)
        self.reward_spec = Unbounded((*batch, 1), **numbers)
        flag = Binary(1, (*batch, 1), dtype=torch.bool, device=device)
        self.full_done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=batch
        )

    def _set_seed(self, seed: int | None) -> None:
        if seed is None:
            seed = int(torch.randint(2**62, ()))
        self._generator = torch.Generator(self._torch_device).manual_seed(seed)

    def _enter(self, state: State) -> None:
        self.position, self.battery, self.goal = state

    def _reset(self, tensordict: TensorDictBase | None = None, **chosen: Any) -> TensorDictBase:
        fresh = self.dynamics.sample(self.batch_size, self._generator, **chosen)
        steps = torch.zeros_like(self.steps)
        if tensordict is not None and (mask := tensordict.get("_reset", None)) is not None:
            mask = mask.reshape(self.batch_size)
            fresh = fresh.where(mask, self.state)
            steps = torch.where(mask, steps, self.steps)
        self._enter(fresh)
        self.steps = steps
        shape = (*self.batch_size, len(CONSTRAINT_NAMES))
        return self._output({"cost": self.position.new_zeros(shape)})

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action")
        if action.shape != (*self.batch_size, 2):
            raise ValueError(
                f"action: expected shape {(*self.batch_size, 2)}, given {tuple(action.shape)}"
            )
        # As it is clipped: what is infinite becomes a bound.
        refuse_non_finite("action", action.clamp(-1, 1), "look for the policy's first NaN")
        outcome = self.dynamics.step(self.state, action, self._generator)
        self._enter(outcome.state)
        self.steps = self.steps + 1
        return self._output({"cost": outcome.cost, "reward": outcome.reward.unsqueeze(-1)})

    def _output(self, entries: dict[str, Tensor]) -> TensorDict:
        truncated = (self.steps >= self.max_steps).unsqueeze(-1)
        entries |= {
            "observation": self.state.observation(),
            "done": truncated.clone(),
            "terminated": torch.zeros_like(truncated),
            "truncated": truncated,
        }
        return TensorDict(entries, batch_size=self.batch_size, device=self.device)

    def get_extra_state(self) -> dict[str, Tensor]:
        """Return the generator's state, so that `state_dict` resumes the episode exactly."""
        return {"generator": self._generator.get_state()}

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """Restore the generator's state."""
        self._generator.set_state(state["generator"].cpu())
