"""Wrappers of Gymnasium environments, single and vector, that map actions to allowed ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from tensordict import TensorDictBase

from cnfp_torchrl.envs import (
    ConstraintCost,
    GeometryTransform,
    Indicator,
    constrain_env,
    constraint_bijectors,
)
from cnfp_torchrl.keys import CONSTRAINTS_KEY, COST_KEY, EXECUTED_ACTION_KEY
from cnfp_torchrl.modules import (
    ConstrainedFlowModule,
    Flow,
    FreeActionMap,
    resolve_safe_flow,
)
from cnfp_torchrl.wrappers.observed_env import ObservedEnv

Array: TypeAlias = NDArray[Any]
Info: TypeAlias = dict[str, Any]


class ConstrainedActions(gymnasium.Wrapper[Any, Array, Any, Array]):
    """Map every action of an agent to an allowed one; the agent knows nothing of constraints.

    The agent acts in [-1, 1]^d, and what is executed lies in all sets::

        env = ConstrainedActions(gymnasium.make("MyRobot-v0"), SpeedLimit(), KeepDistance())
        model = stable_baselines3.SAC("MlpPolicy", env)

    The geometries read the observation by the keys that TorchRL's ``GymEnv`` uses: ``observation``,
    or the names of a dictionary. Wrap before wrappers that change observations.

    Every info holds ``constraints``, the geometry of the state that is returned with it, in which
    the agent acts next: of each constraint by its name the sets' fields, ``active`` and
    ``relaxation``, and the ``anchor`` of all. After a step it holds ``executed_action``, too. With
    indicators ``cost`` holds their violations, float32 ``(K,)``, zeros after a reset. What else is
    in an info, such as an environment's own ``cost``, stays.

    Args:
        env: The environment; its actions are a bounded box of vectors.
        geometries: One transform for each constraint, as for `cnfp_torchrl.constrain_env`.
        order: The constraints' names in order of application, the last with the highest priority;
            None takes the order of the geometries.
        indicators: Functions of the tensordicts before and after a step, by the constraint's name,
            that count violations, as for `cnfp_torchrl.envs.ConstraintCost`; for environments that
            publish no ``cost``.
        flow: The rule that combines the sets; one that guarantees nothing is refused.
        unbounded: Whether the agent acts in R^d instead.

    Raises:
        TypeError: when actions are no box of vectors, a geometry is no `GeometryTransform`, or
            indicators are no functions by their names.
        ValueError: when the action bounds are not finite, for a flow that guarantees nothing, and
            at a step for an action that is not finite.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Array],
        *geometries: GeometryTransform,
        order: Sequence[str] | None = None,
        indicators: Mapping[str, Indicator] | None = None,
        flow: Flow | str = "exact",
        unbounded: bool = False,
    ) -> None:
        if isinstance(env, VectorEnv):
            raise TypeError(
                "env: expected a single environment, given one of several; wrap it in "
                "VectorConstrainedActions"
            )
        super().__init__(env)
        observed = ObservedEnv(env.observation_space, env.action_space)
        self._flow = _FlowInFront(observed, geometries, order, flow, unbounded)
        self.action_space = self._flow.action_space
        self._judge = _judge(indicators)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, Info]:
        """Reset the environment; its geometry is in the info."""
        observation, info = self.env.reset(seed=seed, options=options)
        info = info | self._flow.observe(observation)
        if self._judge is not None:
            info[COST_KEY] = np.zeros(len(self._judge.constraint_names), np.float32)
        return observation, info

    def step(self, action: Array) -> tuple[Any, Any, bool, bool, Info]:
        """Execute the allowed action that an action of the agent is mapped to."""
        executed = self._flow.allowed(action)
        observation, reward, terminated, truncated, info = self.env.step(executed)
        info = info | self._flow.observe(observation) | {EXECUTED_ACTION_KEY: executed}
        if self._judge is not None:
            info[COST_KEY] = self._flow.cost(self._judge)
        return observation, reward, terminated, truncated, info


class VectorConstrainedActions(VectorWrapper):
    """Map every action of agents in a vector environment to an allowed one.

    The geometry of all agents is computed at once. Everything else is as in `ConstrainedActions`;
    infos hold arrays over the agents, as infos of vector environments do.

    Args:
        env: The vector environment, of any autoreset mode.
        geometries: One transform for each constraint, as for `cnfp_torchrl.constrain_env`.
        order: The constraints' names in order of application, the last with the highest priority;
            None takes the order of the geometries.
        indicators: Functions that count violations, as in `ConstrainedActions`; not with the
            autoreset mode SAME_STEP, which hides the last observation of an episode.
        flow: The rule that combines the sets; one that guarantees nothing is refused.
        unbounded: Whether the agents act in R^d instead.

    Raises:
        TypeError: when actions are no box of vectors, a geometry is no `GeometryTransform`, or
            indicators are no functions by their names.
        ValueError: when the action bounds are not finite, for a flow that guarantees nothing, for
            indicators with SAME_STEP, and at a step for an action that is not finite.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        *geometries: GeometryTransform,
        order: Sequence[str] | None = None,
        indicators: Mapping[str, Indicator] | None = None,
        flow: Flow | str = "exact",
        unbounded: bool = False,
    ) -> None:
        super().__init__(env)
        agents = (env.num_envs,)
        observed = ObservedEnv(env.single_observation_space, env.single_action_space, agents)
        self._flow = _FlowInFront(observed, geometries, order, flow, unbounded)
        self.single_action_space = self._flow.action_space
        self.action_space = batch_space(self.single_action_space, env.num_envs)
        self._judge = _judge(indicators)
        mode = env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP)
        if self._judge is not None and mode == AutoresetMode.SAME_STEP:
            raise ValueError(
                "indicators: expected none with the autoreset mode SAME_STEP, which hides the "
                "observation that an episode ends with, given both; take NEXT_STEP"
            )
        self._resets_next_step = mode == AutoresetMode.NEXT_STEP
        self._over = np.zeros(env.num_envs, dtype=bool)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, Info]:
        """Reset all environments, or those that the options choose."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._over = np.zeros(self.num_envs, dtype=bool)
        info = self._with_geometry(info, observation)
        if self._judge is not None:
            cost = np.zeros((self.num_envs, len(self._judge.constraint_names)), np.float32)
            info |= self._everywhere({COST_KEY: cost})
        return observation, info

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, Info]:
        """Execute the allowed actions that those of the agents are mapped to."""
        executed = self._flow.allowed(actions)
        observation, reward, terminated, truncated, info = self.env.step(executed)
        info = self._with_geometry(info, observation) | self._everywhere(
            {EXECUTED_ACTION_KEY: executed}
        )
        if self._judge is not None:
            # A step after the end of an episode is a reset, and executes nothing.
            cost = np.where(self._over[:, None], np.float32(0), self._flow.cost(self._judge))
            info |= self._everywhere({COST_KEY: cost})
        if self._resets_next_step:
            self._over = np.logical_or(terminated, truncated)
        return observation, reward, terminated, truncated, info

    def _with_geometry(self, info: Info, observation: Any) -> Info:
        return info | self._everywhere(self._flow.observe(observation))

    def _everywhere(self, entries: Mapping[str, Any]) -> Info:
        """Return entries with the flags that infos of vector environments have beside them."""
        flags = {f"_{name}": np.ones(self.num_envs, dtype=bool) for name in entries}
        return {**entries, **flags}


def _judge(indicators: Mapping[str, Indicator] | None) -> ConstraintCost | None:
    return None if indicators is None else ConstraintCost(indicators)


class _FlowInFront:
    """The constraints of what was observed, and the map into them."""

    def __init__(
        self,
        observed: ObservedEnv,
        geometries: Sequence[GeometryTransform],
        order: Sequence[str] | None,
        flow: Flow | str,
        unbounded: bool,
    ) -> None:
        self._observed = observed
        self._env = constrain_env(observed, *geometries, order=order)
        spec = self._env.action_spec_unbatched
        flow = resolve_safe_flow(flow)
        head = ConstrainedFlowModule(spec, constraint_bijectors(self._env), flow=flow)
        self._map = FreeActionMap(head, unbounded=unbounded)
        self._state: TensorDictBase | None = None
        self._acted: TensorDictBase | None = None
        free = self._map.spec
        low, high = (-np.inf, np.inf) if unbounded else (-1.0, 1.0)
        dtype = np.float64 if free.dtype == torch.float64 else np.float32
        self.action_space = gymnasium.spaces.Box(low, high, tuple(free.shape), dtype)

    @torch.no_grad()
    def observe(self, observation: Any) -> Info:
        """Find what is allowed where something was observed, and return it for an info."""
        self._observed.show(observation)
        self._state = self._env.reset()
        constraints = self._state.get(CONSTRAINTS_KEY)
        return {CONSTRAINTS_KEY: _arrays(constraints)}

    @torch.no_grad()
    def allowed(self, free: Any) -> Array:
        """Return the allowed action of a free one where something was observed last."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("step: expected a call of reset() first")
        given = np.asarray(free, dtype=self.action_space.dtype)
        shape = (*self._env.batch_size, *self.action_space.shape)
        if given.shape != shape:
            raise ValueError(f"action: expected shape {shape}, given {given.shape}")
        head = self._map.head
        state = self._state.copy().set(head.action_key, torch.from_numpy(given.copy()))
        self._acted = self._map(state)
        executed: Array = self._acted.get(head.action_key).numpy().copy()
        return executed

    def cost(self, judge: ConstraintCost) -> Array:
        """Return the costs of the last action, in the state before what was observed last."""
        assert self._acted is not None
        assert self._state is not None
        cost: Array = judge.evaluate(self._acted, self._state).numpy()
        return cost


def _arrays(entries: TensorDictBase) -> Info:
    # Copies: the agent may keep an info, and the geometry is read again at the next step.
    return {
        name: _arrays(value) if isinstance(value, TensorDictBase) else value.numpy().copy()
        for name, value in entries.items()
    }
