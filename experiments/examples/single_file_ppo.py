"""PPO in a single file, as researchers write it, made safe by one line around the environments.

    python experiments/examples/single_file_ppo.py [--steps 50000] [--unsafe]

Everything but that line is an ordinary PPO on Gymnasium's vector environments: a Gaussian in R^d
whose samples are clipped, and stored as they were drawn. Violations are counted by the environments
themselves.
"""

import argparse
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torch import Tensor, nn
from torch.distributions import Normal

from cnfp_torchrl.tasks.point_nav import POINT_NAV_ID, BatteryGeometry, ObstacleGeometry
from cnfp_torchrl.wrappers import VectorConstrainedActions

GAMMA, LAMBDA, CLIP, EPOCHS, MINIBATCHES = 0.95, 0.95, 0.2, 4, 4


class Agent(nn.Module):
    """A Gaussian policy and a value function."""

    def __init__(self, observations: int, actions: int) -> None:
        super().__init__()
        self.mean, self.value = (
            nn.Sequential(
                *(nn.Linear(observations, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh()),
                nn.Linear(64, outputs),
            )
            for outputs in (actions, 1)
        )
        self.log_std = nn.Parameter(torch.full((actions,), -0.5))

    def policy(self, observation: Tensor) -> Normal:
        """Return the distribution of actions."""
        return Normal(self.mean(observation), self.log_std.exp())


def main() -> None:
    """Train on point navigation and count violations."""
    parser = argparse.ArgumentParser(description="PPO in a single file, with hard constraints.")
    parser.add_argument("--steps", type=int, default=50000, help="environment steps")
    parser.add_argument("--agents", type=int, default=16, help="that act in parallel")
    parser.add_argument("--length", type=int, default=128, help="steps of each between updates")
    parser.add_argument("--unsafe", action="store_true", help="leave the constraints out")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)
    torch.set_num_threads(1)

    envs: Any = SyncVectorEnv(
        [lambda: gymnasium.make(POINT_NAV_ID)] * arguments.agents,
        autoreset_mode=AutoresetMode.SAME_STEP,
    )
    if not arguments.unsafe:
        # The last constraint has the highest priority.
        envs = VectorConstrainedActions(envs, BatteryGeometry(), ObstacleGeometry())

    agent = Agent(envs.single_observation_space.shape[0], envs.single_action_space.shape[0])
    optimizer = torch.optim.Adam(agent.parameters(), lr=1e-3)
    observation, _ = envs.reset(seed=arguments.seed)
    observation = torch.as_tensor(observation)
    violations, rewards = np.zeros(2), []
    for _ in range(max(arguments.steps // (arguments.agents * arguments.length), 1)):
        steps: list[tuple[Tensor, ...]] = []
        for _ in range(arguments.length):
            with torch.no_grad():
                policy = agent.policy(observation)
                action = policy.sample()
            found, reward, terminated, truncated, info = envs.step(action.clamp(-1, 1).numpy())
            violations += info["cost"].sum(0)
            rewards.append(reward.mean())
            # Episodes of this task end by the clock alone, so that values go on beyond the end.
            after = torch.as_tensor(found).clone()
            for index in np.flatnonzero(truncated):
                after[index] = torch.as_tensor(info["final_obs"][index])
            over = torch.as_tensor(terminated | truncated)
            given = torch.as_tensor(reward, dtype=torch.float32)
            steps.append((observation, action, policy.log_prob(action).sum(-1), given, after, over))
            observation = torch.as_tensor(found)
        update(agent, optimizer, *(torch.stack(entries) for entries in zip(*steps, strict=True)))
    taken = len(rewards) * arguments.agents
    print(f"mean reward in the last quarter {np.mean(rewards[-len(rewards) // 4 :]):.2f}")
    for name, count in zip(("obstacle", "battery"), violations, strict=True):
        print(f"{name}: {count:.0f} violations in {taken} steps")


def update(
    agent: Agent,
    optimizer: torch.optim.Optimizer,
    observation: Tensor,
    action: Tensor,
    log_prob: Tensor,
    reward: Tensor,
    after: Tensor,
    over: Tensor,
) -> None:
    """Improve the agent by steps ``(time, agents, ...)``."""
    with torch.no_grad():
        value, next_value = agent.value(observation)[..., 0], agent.value(after)[..., 0]
        surprise = reward + GAMMA * next_value - value
        advantage, running = torch.zeros_like(reward), torch.zeros_like(reward[0])
        for time in reversed(range(len(reward))):
            running = surprise[time] + GAMMA * LAMBDA * running.masked_fill(over[time], 0)
            advantage[time] = running
    target = advantage + value
    data = [values.flatten(0, 1) for values in (observation, action, log_prob, advantage, target)]
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(data[0])).chunk(MINIBATCHES):
            seen, acted, old, gain, wanted = (value[rows] for value in data)
            policy = agent.policy(seen)
            ratio = (policy.log_prob(acted).sum(-1) - old).exp()
            gain = (gain - gain.mean()) / (gain.std() + 1e-8)
            clipped = torch.minimum(ratio * gain, ratio.clamp(1 - CLIP, 1 + CLIP) * gain)
            value_loss = (agent.value(seen)[..., 0] - wanted).square().mean()
            optimizer.zero_grad()
            (-clipped.mean() + 0.5 * value_loss).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimizer.step()


if __name__ == "__main__":
    main()
