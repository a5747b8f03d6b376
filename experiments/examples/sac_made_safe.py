"""A SAC script made safe by appending constraints to its actor.

    python experiments/examples/sac_made_safe.py [--steps 8000] [--unsafe]

Without the lines marked `# safe` it is what anybody would write who knows TorchRL and has never
heard of constraints. Violations are counted by the environment, on every executed action of the
training.
"""

import argparse

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase
from torchrl.modules import (
    MLP,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import SACLoss, SoftUpdate

from cnfp_torchrl import constrain, constrain_env  # safe
from cnfp_torchrl.tasks import point_nav


def main() -> None:
    """Train on point navigation and count violations."""
    parser = argparse.ArgumentParser(description="SAC with hard constraints on point navigation.")
    parser.add_argument("--steps", type=int, default=8000, help="environment steps")
    parser.add_argument("--agents", type=int, default=16, help="that act in parallel")
    parser.add_argument("--updates", type=int, default=32, help="for each 8 steps of all agents")
    parser.add_argument("--unsafe", action="store_true", help="leave constraints out")  # safe
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)

    env: EnvBase = point_nav.PointNavEnv([arguments.agents], seed=arguments.seed)
    actor = make_actor(env)
    if not arguments.unsafe:  # safe
        # The environment publishes what each state allows (the last constraint is the most
        # important), and the actor heeds it.
        geometries = point_nav.BatteryGeometry(), point_nav.ObstacleGeometry()  # safe
        env = constrain_env(env, *geometries)  # safe
        actor = constrain(actor, env)  # safe

    steps = train(env, actor, steps=arguments.steps, updates=arguments.updates)
    reward, last = steps["next", "reward"], -len(steps) // 4
    print(f"mean reward {reward.mean():.2f}, in the last quarter {reward[last:].mean():.2f}")
    for name, count in zip(env.constraint_names, steps["next", "cost"].sum(0), strict=True):
        print(f"{name}: {count:.0f} violations in {len(steps)} steps")


def make_actor(env: EnvBase) -> ProbabilisticActor:
    """Return an ordinary tanh-Gaussian actor."""
    observation_size = env.observation_spec["observation"].shape[-1]
    spec = env.action_spec_unbatched
    network = torch.nn.Sequential(
        MLP(observation_size, 2 * spec.shape[-1], num_cells=[64, 64]), NormalParamExtractor()
    )
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=spec,
        distribution_class=TanhNormal,
    )


def train(env: EnvBase, actor: TensorDictModuleBase, *, steps: int, updates: int) -> TensorDictBase:
    """Train an actor with SAC and return all its transitions, ``(steps,)``."""
    observation_size = env.observation_spec["observation"].shape[-1]
    spec = env.action_spec_unbatched
    critic = ValueOperator(
        MLP(observation_size + spec.shape[-1], 1, num_cells=[64, 64]),
        in_keys=["observation", "action"],
    )
    loss = SACLoss(actor, critic, action_spec=spec)
    loss.make_value_estimator(gamma=0.99)
    target = SoftUpdate(loss, tau=0.005)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    frames = 8 * env.numel()
    storage = LazyTensorStorage(steps + frames)  # the last batch may go beyond the steps
    buffer = TensorDictReplayBuffer(storage=storage, batch_size=128)
    # No init_random_frames here: TorchRL draws those from the action spec, past every actor.
    collector = Collector(
        env,
        actor,
        frames_per_batch=frames,
        total_frames=steps,
        auto_register_policy_transforms=False,
    )
    for batch in collector:
        buffer.extend(batch.reshape(-1))
        for _ in range(updates):
            losses = loss(buffer.sample())
            optimizer.zero_grad()
            (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).backward()
            optimizer.step()
            target.step()
    collector.shutdown()
    return buffer[:]


if __name__ == "__main__":
    main()
