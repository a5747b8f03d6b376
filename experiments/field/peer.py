"""Stable-Baselines3's SAC on the same environment, which projects what it is told to do."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from omegaconf import DictConfig
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import VecEnv
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from cnfp_torchrl.geometry import project_onto_intersection
from cnfp_torchrl.modules import flow_head
from cnfp_torchrl.training.agent import build_actor, build_environment
from experiments.field.curve import Curve


class Projector:
    """Projects actions onto what states allow, as an environment's own last step.

    Args:
        config: The configuration of a run with ``flow=projection``.
        env: Its environment.
    """

    def __init__(self, config: DictConfig, env: TransformedEnv) -> None:
        self.head, self.rounds = flow_head(build_actor(config, env)), config.flow.rounds

    @torch.no_grad()
    def __call__(self, states: TensorDictBase, actions: np.ndarray) -> Tensor:
        """Return the closest allowed actions."""
        region = self.head.get_region(states).eroded()
        wanted = torch.as_tensor(actions, dtype=torch.float32)
        return region.pulled_in(project_onto_intersection(region, wanted, self.rounds))


class ProjectingEnvs(VecEnv):
    """An environment's agents as environments of Stable-Baselines3.

    Args:
        config: The configuration of a run with ``flow=projection``.
        curve: What takes rewards and ends.
    """

    def __init__(self, config: DictConfig, curve: Curve) -> None:
        self.env = build_environment(config)
        self.env.set_seed(config.seed)
        self.project = Projector(config, self.env)
        self.curve, self.steps = curve, 0
        spec = self.env.action_spec_unbatched.space
        size = self.env.observation_spec["observation"].shape[-1]
        self.violations = torch.zeros(self.env.observation_spec["cost"].shape[-1])
        self.relaxed = dict.fromkeys(self.project.head.order, 0)
        super().__init__(
            self.env.batch_size.numel(),
            gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32),
            gymnasium.spaces.Box(spec.low.numpy(), spec.high.numpy(), dtype=np.float32),
        )

    def reset(self) -> Any:
        self.state = self.env.reset()
        return self.state["observation"].numpy()

    def step_async(self, actions: np.ndarray) -> None:
        self.state["action"] = self.project(self.state, actions)
        for name in self.relaxed:
            self.relaxed[name] += int((~self.state["constraints", name, "active"]).sum())

    def step_wait(self) -> Any:
        transition, self.state = self.env.step_and_maybe_reset(self.state)
        outcome = transition["next"]
        reward, done = outcome["reward"].squeeze(-1), outcome["done"].squeeze(-1)
        self.violations += outcome["cost"].sum(0)
        self.steps += len(done)
        self.curve.add(reward, done)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for index in done.nonzero().squeeze(-1).tolist():
            infos[index] = {
                "terminal_observation": outcome["observation"][index].numpy(),
                "TimeLimit.truncated": not bool(outcome["terminated"][index]),
            }
        return self.state["observation"].numpy(), reward.numpy(), done.numpy(), infos

    def close(self) -> None:
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


def train_peer(config: DictConfig) -> tuple[Any, dict[str, Any]]:
    """Train by the settings of ours; return what acts, and entries of the record."""
    curve = Curve(config.env.agents, config.training.warmup_frames)
    envs = ProjectingEnvs(config, curve)
    model = SAC(
        "MlpPolicy",
        envs,
        learning_rate=config.optim.lr,
        buffer_size=config.replay_buffer.storage.max_size,
        batch_size=config.replay_buffer.batch_size,
        gamma=config.loss.gamma,
        tau=config.target.tau,
        train_freq=1,
        gradient_steps=round(config.env.agents * config.training.update_ratio),
        learning_starts=config.training.warmup_frames,
        target_entropy=config.loss.target_entropy,
        policy_kwargs={"net_arch": list(config.network.hidden)},
        device=config.get("device") or "cpu",
        seed=config.seed,
    )
    model.learn(config.collector.total_frames)

    def act(states: TensorDictBase, greedy: bool) -> tuple[Tensor, Tensor]:
        wanted, _ = model.predict(states["observation"].numpy(), deterministic=greedy)
        return envs.project(states, wanted), torch.as_tensor(wanted)

    names = envs.env.base_env.constraint_names
    return act, {
        **curve.kept(),
        "projections": envs.steps,
        "violations": dict(zip(names, envs.violations.long().tolist(), strict=True)),
        "relaxed": {name: count / envs.steps for name, count in envs.relaxed.items()},
    }
