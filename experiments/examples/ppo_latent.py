"""PPO on a constrained actor: latents are stored and scored, so that its ratios are exact.

python experiments/examples/ppo_latent.py [--iterations 10]
"""

import argparse

import torch
from torchrl.collectors import Collector
from torchrl.modules import MLP, NormalParamExtractor, ValueOperator

from cnfp_torchrl import constrain_env, make_constrained_actor
from cnfp_torchrl.modules import split_at_latent
from cnfp_torchrl.objectives import ConstrainedPPOLoss
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv


def main() -> None:
    """Train on point navigation and count violations."""
    parser = argparse.ArgumentParser(description="PPO with hard constraints on point navigation.")
    parser.add_argument("--iterations", type=int, default=10, help="of collecting and learning")
    parser.add_argument("--agents", type=int, default=32, help="that act in parallel")
    parser.add_argument("--horizon", type=int, default=100, help="steps of an agent an iteration")
    parser.add_argument("--epochs", type=int, default=5, help="passes over the steps collected")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)

    base_env = PointNavEnv([arguments.agents], seed=arguments.seed)
    env = constrain_env(base_env, BatteryGeometry(), ObstacleGeometry())
    network = torch.nn.Sequential(MLP(5, 4, num_cells=[64, 64]), NormalParamExtractor())
    actor = make_constrained_actor(network, env)
    policy = split_at_latent(actor).policy  # also stores latents, which the loss scores

    critic = ValueOperator(MLP(5, 1, num_cells=[64, 64]), in_keys=["observation"])
    loss = ConstrainedPPOLoss(actor, critic, entropy_coeff=1e-3)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    frames = arguments.agents * arguments.horizon
    collector = Collector(
        env,
        policy,
        frames_per_batch=frames,
        total_frames=frames * arguments.iterations,
        auto_register_policy_transforms=False,
    )
    violations = torch.zeros(len(env.constraint_names))
    for iteration, batch in enumerate(collector):
        loss.value_estimator(batch)
        steps = batch.reshape(-1)
        violations += steps["next", "cost"].sum(0)
        fresh = loss(steps)  # nothing was updated since: the ratios must be 1
        for _ in range(arguments.epochs):
            for part in steps[torch.randperm(len(steps))].split(256):
                losses = loss(part)
                optimizer.zero_grad()
                sum(v for k, v in losses.items() if k.startswith("loss_")).backward()
                torch.nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimizer.step()
        print(
            f"iteration {iteration}: mean reward {steps['next', 'reward'].mean():.2f}, before the "
            f"update ESS {fresh['ESS']:.6f} and KL {fresh['kl_approx']:.1e}"
        )
    collector.shutdown()
    for name, count in zip(env.constraint_names, violations, strict=True):
        print(f"{name}: {count:.0f} violations in {frames * arguments.iterations} steps")


if __name__ == "__main__":
    main()
