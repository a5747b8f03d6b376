"""The unicycle as a batched TorchRL environment, for reinforcement learning and audits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from cnfp_torchrl.envs import Component, Map, Marks, Polyline, TaskView
from cnfp_torchrl.keys import refuse_non_finite
from cnfp_torchrl.tasks.safe_control.judge import barrier_excess, barrier_values
from cnfp_torchrl.tasks.safe_control.unicycle import Problem, encoded, motion, starts, step_cost

STATE_RANGE = (4.5, 4.5, torch.pi, 5.0, 10.0)
"""The largest state that the observation spec names, of which audits draw."""


class SafeControlEnv(EnvBase):
    """Steer a unicycle past two ellipses to the origin, judged by its barriers.

    Episodes take one step of Euler's method for each action and have no terminal state; they are
    truncated after `Problem.duration`. Actions go up to `Problem.largest`, from which on the
    published integrator would shorten its steps. The state is float64, so that the judge's own
    rounding is far below that of float32 actions.

    Keys, with ``*b`` the batch size:
        - ``observation`` float32 ``(*b, 6)``: x, y, cos and sin of the heading, speed, turn rate,
        - ``state`` float64 ``(*b, 5)``: x, y, heading, speed, turn rate,
        - ``action`` float32 ``(*b, 2)``: the accelerations of speed and turn rate,
        - ``reward`` float32 ``(*b, 1)``: minus what the step costs,
        - ``cost`` float32 ``(*b, 1)``: 1 where the action broke a barrier; 0 after a reset,
        - ``done``, ``terminated`` (never), ``truncated`` bool ``(*b, 1)``.

    Args:
        batch_size: The shape of the batch of unicycles, which are independent of each other.
        problem: The sizes; None takes the published ones.
        max_steps: The length at which an episode is truncated; None takes the problem's.
        device: The device to compute on.
        seed: The seed of the starts, drawn from the published ones; None takes one from torch's
            global generator.

    Raises:
        ValueError: for a bad argument, and for an action that is not finite.
    """

    constraint_names: tuple[str, ...] = ("barriers",)

    state: Tensor
    steps: Tensor

    def __init__(
        self,
        batch_size: Sequence[int] = (),
        *,
        problem: Problem | None = None,
        max_steps: int | None = None,
        device: torch.device | str | None = None,
        seed: int | None = None,
    ) -> None:
        if any(size < 1 for size in batch_size):
            raise ValueError(f"batch_size: expected sizes >= 1, given {tuple(batch_size)}")
        if max_steps is not None and max_steps < 1:
            raise ValueError(f"max_steps: expected a whole number >= 1, given {max_steps!r}")
        super().__init__(device=device, batch_size=torch.Size(batch_size))
        self.problem = Problem() if problem is None else problem
        self.max_steps = max_steps or round(self.problem.duration / self.problem.dt)
        self._starts = starts(partial(barrier_values, self.problem)).to(self._on)
        self._make_specs()
        self.register_buffer("state", self._starts[0].expand(*self.batch_size, 5).clone())
        self.register_buffer(
            "steps", torch.zeros(self.batch_size, dtype=torch.int64, device=self._on)
        )
        self.set_seed(seed)

    def task_view(self, env: EnvBase) -> TaskView:
        """Return what this task shows of itself."""
        return SafeControlView(self.problem)

    @property
    def _on(self) -> torch.device:
        return torch.device("cpu") if self.device is None else self.device

    def _make_specs(self) -> None:
        batch, device = self.batch_size, self._on
        numbers: dict[str, Any] = {"device": device, "dtype": torch.float32}
        most = torch.tensor(STATE_RANGE, dtype=torch.float64, device=device).expand(*batch, 5)
        self.observation_spec = Composite(
            observation=Unbounded((*batch, 6), **numbers),
            state=Bounded(-most, most, dtype=torch.float64, device=device),
            cost=Bounded(0.0, 1.0, (*batch, 1), **numbers),
            shape=batch,
        )
        largest = self.problem.largest
        self.action_spec = Bounded(-largest, largest, (*batch, 2), **numbers)
        self.reward_spec = Unbounded((*batch, 1), **numbers)
        flag = Binary(1, (*batch, 1), dtype=torch.bool, device=device)
        self.full_done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=batch
        )

    def _set_seed(self, seed: int | None) -> None:
        seed = int(torch.randint(2**62, ())) if seed is None else seed
        self._generator = torch.Generator().manual_seed(seed)

    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        *,
        state: Tensor | None = None,
        **kwargs: Any,
    ) -> TensorDictBase:
        if state is None:
            chosen = torch.randint(len(self._starts), self.batch_size, generator=self._generator)
            state = self._starts[chosen.to(self._on)]
        steps = torch.zeros_like(self.steps)
        if tensordict is not None and (mask := tensordict.get("_reset", None)) is not None:
            mask = mask.reshape(self.batch_size)
            state = torch.where(mask.unsqueeze(-1), state, self.state)
            steps = torch.where(mask, steps, self.steps)
        self.state, self.steps = state.to(self.state).expand_as(self.state).clone(), steps
        return self._output(self.state.new_zeros(*self.batch_size, 1))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action")
        refuse_non_finite("action", action, "look for the policy's first NaN")
        control, rows = action.detach().double(), self.state.reshape(-1, 5)
        broken = barrier_excess(self.problem, rows, control.reshape(-1, 2)).amax(-1) > 0
        dt = self.problem.dt
        reward = -dt * step_cost(self.problem, self.state, control)
        self.state = self.state + dt * motion(self.state, control)
        self.steps = self.steps + 1
        return self._output(broken.reshape(*self.batch_size, 1), reward.unsqueeze(-1).float())

    def _output(self, broken: Tensor, reward: Tensor | None = None) -> TensorDict:
        truncated = (self.steps >= self.max_steps).unsqueeze(-1)
        entries = {
            "observation": encoded(self.state).float(),
            "state": self.state,
            "cost": broken.float(),
            "done": truncated.clone(),
            "terminated": torch.zeros_like(truncated),
            "truncated": truncated,
        }
        if reward is not None:
            entries["reward"] = reward
        return TensorDict(entries, batch_size=self.batch_size, device=self.device)

    def get_extra_state(self) -> dict[str, Tensor]:
        """Return the generator's state, so that `state_dict` resumes the episode exactly."""
        return {"generator": self._generator.get_state()}

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """Restore the generator's state."""
        self._generator.set_state(state["generator"].cpu())


class SafeControlView(TaskView):
    """The view of the task: a map with the goal, and names of all components.

    Args:
        problem: The sizes.
    """

    action_components = (Component("acceleration", "m/s²"), Component("turn acceleration", "1/s²"))
    observation_components = (
        *(Component("x", "m"), Component("y", "m")),
        *(Component("cos heading"), Component("sin heading")),
        *(Component("speed", "m/s"), Component("turn rate", "1/s")),
    )
    position_keys = ("state",)

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        edges = tuple(
            Polyline(name=f"ellipses/{number}", points=edge(*ellipse))
            for number, ellipse in enumerate(problem.ellipses, 1)
        )
        goal = Marks(name="goal", points=((0.0, 0.0),), color="#0072B2", label="goal")
        self.map = Map((-4.5, 1.0), (-2.0, 2.0), "m", (*edges, goal))

    def position(self, states: TensorDictBase) -> Tensor:
        """Return the point ahead of the axle, which must stay outside."""
        x, y, heading = states["state"][..., :3].unbind(-1)
        ahead = self.problem.ahead
        return torch.stack([x + ahead * heading.cos(), y + ahead * heading.sin()], -1)

    @staticmethod
    def state_setter(env: EnvBase, states: TensorDictBase) -> TensorDictBase:
        """Put a `SafeControlEnv` into states."""
        return env.reset(state=states["state"])


def edge(
    x: float, y: float, half_x: float, half_y: float, count: int = 64
) -> tuple[tuple[float, float], ...]:
    """Return points of an ellipse's edge, the first one again at the end."""
    turns = [2 * math.pi * index / count for index in range(count + 1)]
    return tuple((x + half_x * math.cos(turn), y + half_y * math.sin(turn)) for turn in turns)
