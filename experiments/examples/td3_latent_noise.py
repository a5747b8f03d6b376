"""TD3 on a constrained deterministic actor: all its noise goes into the latent.

    python experiments/examples/td3_latent_noise.py [--steps 8000]

Both of TD3's noises, of exploration and of the smoothed target, are added before the flow, which
carries them to allowed actions. Added to the action, they would break the constraints.
"""

import argparse

import torch
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate

from cnfp_torchrl import constrain_env, make_constrained_actor
from cnfp_torchrl.modules import split_at_latent
from cnfp_torchrl.objectives import ConstrainedTD3Loss
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.training.networks import action_value_network, deterministic_network


def main() -> None:
    """Train on point navigation and count violations."""
    parser = argparse.ArgumentParser(description="TD3 with hard constraints on point navigation.")
    parser.add_argument("--steps", type=int, default=8000, help="environment steps")
    parser.add_argument("--agents", type=int, default=16, help="that act in parallel")
    parser.add_argument("--updates", type=int, default=32, help="for each 8 steps of all agents")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)

    base_env = PointNavEnv([arguments.agents], seed=arguments.seed)
    env = constrain_env(base_env, BatteryGeometry(), ObstacleGeometry())
    # The scale of its Gaussian is that of exploration, and is not learned.
    actor = make_constrained_actor(deterministic_network(5, 2, hidden=[64, 64], noise=0.3), env)
    policy = split_at_latent(actor).policy  # also stores latents, the actions to the loss
    loss = ConstrainedTD3Loss(actor, action_value_network(5, 2, hidden=[64, 64]))
    target = SoftUpdate(loss, tau=0.005)
    actor_optimizer = torch.optim.Adam(loss.actor_network_params.parameters(), lr=1e-3)
    critic_optimizer = torch.optim.Adam(loss.qvalue_network_params.parameters(), lr=1e-3)

    frames = 8 * arguments.agents
    storage = LazyTensorStorage(arguments.steps + frames)  # the last batch may go beyond the steps
    buffer = TensorDictReplayBuffer(storage=storage, batch_size=128)
    collector = Collector(
        env,
        policy,
        frames_per_batch=frames,
        total_frames=arguments.steps,
        auto_register_policy_transforms=False,
    )
    for batch in collector:
        buffer.extend(batch.reshape(-1))
        for update in range(arguments.updates):
            sample = buffer.sample()
            critic_optimizer.zero_grad()
            loss.critic_loss(sample)["loss_qvalue"].backward()
            critic_optimizer.step()
            if update % 2 == 0:
                actor_optimizer.zero_grad()
                loss.actor_loss(sample)[0].backward()
                actor_optimizer.step()
                target.step()
    collector.shutdown()

    steps = buffer[:]
    reward, last = steps["next", "reward"], -len(steps) // 4
    print(f"mean reward {reward.mean():.2f}, in the last quarter {reward[last:].mean():.2f}")
    for name, count in zip(env.constraint_names, steps["next", "cost"].sum(0), strict=True):
        print(f"{name}: {count:.0f} violations in {len(steps)} steps")


if __name__ == "__main__":
    main()
