"""Gymnasium's MuJoCo robots as one batched TorchRL environment that is judged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import CatTensors, EnvBase, TransformedEnv

from cnfp_torchrl.envs import PreviousAction, TaskView
from cnfp_torchrl.keys import PREVIOUS_ACTION_KEY, refuse_non_finite
from cnfp_torchrl.tasks.robots.judges import Judge


class RobotEnv(EnvBase):
    """Robots of one kind, stepped one after the other, with the simulator's state and judges.

    Needs MuJoCo, ``pip install "gymnasium[mujoco]"``.

    Keys, with ``*b`` the batch size:
        - ``observation`` float32 ``(*b, n)``: that of Gymnasium,
        - ``qpos``, ``qvel`` float64: the simulator's coordinates and velocities, all of them and
          not clipped as some observations are,
        - ``action`` float32 ``(*b, d)``,
        - ``reward`` float32 ``(*b, 1)``,
        - ``cost`` float32 ``(*b, K)``: what the judges say as 0 or 1, in their order; zeros after a
          reset,
        - ``done``, ``terminated``, ``truncated`` bool ``(*b, 1)``.

    Args:
        robot: The id of a Gymnasium environment of MuJoCo, such as ``HalfCheetah-v5``.
        batch_size: The shape of the batch of robots, which are independent of each other.
        judges: Judges of the constraints by their names.
        max_steps: The length at which an episode is truncated; None takes Gymnasium's.
        seed: The seed of the starts; None takes one from torch's global generator.

    Raises:
        ValueError: for a bad argument, and for an action that is not finite.
        TypeError: for an environment that is not one of MuJoCo's.
    """

    def __init__(
        self,
        robot: str,
        batch_size: Sequence[int] = (),
        *,
        judges: Mapping[str, Judge] | None = None,
        max_steps: int | None = None,
        seed: int | None = None,
    ) -> None:
        if any(size < 1 for size in batch_size):
            raise ValueError(f"batch_size: expected sizes >= 1, given {tuple(batch_size)}")
        super().__init__(device="cpu", batch_size=torch.Size(batch_size))
        self.judges = dict(judges or {})
        self.constraint_names = tuple(self.judges)
        self.robots = [
            gymnasium.make(robot, max_episode_steps=max_steps, disable_env_checker=True)
            for _ in range(self.batch_size.numel())
        ]
        if not hasattr(self.robots[0].unwrapped, "data"):
            raise TypeError(f"robot: expected an environment of MuJoCo, given {robot!r}")
        self._make_specs()
        self.set_seed(seed)

    def task_view(self, env: EnvBase) -> TaskView:
        """Return what this task shows of itself: how to put robots into chosen states."""
        return RobotView()

    def set_states(self, states: TensorDictBase) -> TensorDict:
        """Put the robots into states and return what is then observed.

        Args:
            states: Entries ``qpos`` and ``qvel``, and ``previous_action`` where the motors are not
                to rest; of the environment's batch size.
        """
        rows = states.reshape(-1)
        for index, robot in enumerate(self.robots):
            simulation: Any = robot.unwrapped
            robot.reset()
            simulation.set_state(*(rows[index][key].cpu().numpy() for key in ("qpos", "qvel")))
            if (action := rows[index].get(PREVIOUS_ACTION_KEY, None)) is not None:
                simulation.data.ctrl[:] = action.cpu().numpy()
        shown = [robot.unwrapped._get_obs() for robot in self.robots]  # type: ignore[attr-defined]
        return TensorDict(self._observed(shown), self.batch_size, device=self.device)

    def _make_specs(self) -> None:
        robot, batch = self.robots[0], self.batch_size
        space, actions = robot.observation_space, robot.action_space
        assert isinstance(actions, gymnasium.spaces.Box)
        assert space.shape is not None
        data = robot.unwrapped.data  # type: ignore[attr-defined]
        self.observation_spec = Composite(
            observation=Unbounded((*batch, space.shape[-1]), dtype=torch.float32),
            qpos=Unbounded((*batch, data.qpos.size), dtype=torch.float64),
            qvel=Unbounded((*batch, data.qvel.size), dtype=torch.float64),
            shape=batch,
        )
        if self.judges:
            shape = (*batch, len(self.judges))
            self.observation_spec["cost"] = Bounded(0.0, 1.0, shape, dtype=torch.float32)
        low, high = (
            torch.from_numpy(bound).expand(*batch, -1) for bound in (actions.low, actions.high)
        )
        self.action_spec = Bounded(low, high, dtype=torch.float32)
        self.reward_spec = Unbounded((*batch, 1), dtype=torch.float32)
        flag = Binary(1, (*batch, 1), dtype=torch.bool)
        self.full_done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=batch
        )

    def _set_seed(self, seed: int | None) -> None:
        generator = np.random.default_rng(int(torch.randint(2**62, ())) if seed is None else seed)
        self._seeds: list[int | None] = generator.integers(2**31, size=len(self.robots)).tolist()
        self._shown = [np.zeros(0)] * len(self.robots)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        chosen = torch.ones(len(self.robots), dtype=torch.bool)
        if tensordict is not None and (mask := tensordict.get("_reset", None)) is not None:
            chosen = mask.reshape(-1)
        for index in chosen.nonzero().squeeze(-1).tolist():
            # A seed once; after that each robot's own generator goes on.
            self._shown[index], _ = self.robots[index].reset(seed=self._seeds[index])
            self._seeds[index] = None
        return self._output(np.zeros((len(self.robots), len(self.judges))), {})

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action")
        refuse_non_finite("action", action, "look for the policy's first NaN")
        actions = action.detach().cpu().reshape(len(self.robots), -1).numpy()
        cost = np.zeros((len(self.robots), len(self.judges)))
        outcomes = []
        for index, robot in enumerate(self.robots):
            simulation: Any = robot.unwrapped
            exact = actions[index].astype(np.float64)
            for column, judge in enumerate(self.judges.values()):
                cost[index, column] = judge(simulation.model, simulation.data, exact)
            self._shown[index], reward, *ends, _ = robot.step(actions[index])
            outcomes.append((float(reward), *ends))
        rewards, terminated, truncated = (
            torch.tensor(outcome).reshape(*self.batch_size, 1)
            for outcome in zip(*outcomes, strict=True)
        )
        flags = {"done": terminated | truncated, "terminated": terminated, "truncated": truncated}
        return self._output(cost, {"reward": rewards, **flags})

    def _output(self, cost: np.ndarray, entries: dict[str, Tensor]) -> TensorDict:
        entries |= self._observed(self._shown)
        if self.judges:
            entries["cost"] = torch.from_numpy(cost).float().reshape(*self.batch_size, -1)
        return TensorDict(entries, batch_size=self.batch_size, device=self.device)

    def _observed(self, shown: Sequence[np.ndarray]) -> dict[str, Tensor]:
        datas = [robot.unwrapped.data for robot in self.robots]  # type: ignore[attr-defined]
        columns = {
            "observation": np.stack(shown).astype(np.float32),
            "qpos": np.stack([data.qpos for data in datas]),
            "qvel": np.stack([data.qvel for data in datas]),
        }
        return {
            key: torch.from_numpy(value).reshape(*self.batch_size, -1)
            for key, value in columns.items()
        }


class RobotView(TaskView):
    """The view of a robot: nothing to draw, but states can be chosen."""

    @staticmethod
    def state_setter(env: EnvBase, states: TensorDictBase) -> TensorDictBase:
        """Put a `RobotEnv` into states, the motors' last actions included."""
        assert isinstance(env, RobotEnv)
        return env.set_states(states)


def robot_with_previous_action(
    robot: str, batch_size: Sequence[int] = (), **kwargs: Any
) -> TransformedEnv:
    """Return a `RobotEnv` that publishes its previous action, also at the observation's end.

    Args:
        robot: See `RobotEnv`.
        batch_size: See `RobotEnv`.
        kwargs: Further options of `RobotEnv`.
    """
    env = TransformedEnv(RobotEnv(robot, batch_size, **kwargs), PreviousAction())
    parts = ["observation", PREVIOUS_ACTION_KEY]
    return env.append_transform(CatTensors(parts, "observation", del_keys=False, sort=False))
