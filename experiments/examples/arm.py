r"""An arm of three joints that reaches for a target behind a wall, and never touches the wall.

    python experiments/examples/arm.py [--steps 4000] [--unsafe]

Actions are the joints' velocities a, in rad/s, held for a step dt. Two limits are kept for the end
point p: its speed, |J a| <= 0.5 m/s, by the Jacobian J, and a wall, p_x <= 0.7 m.

The wall is a half-space of positions, but not of actions: p_x = sum_k l_k cos(phi_k) is nonlinear
in the links' directions phi, which a step turns by e = dt cumsum(a). Linearized, J_x a dt <= gap,
it would need a margin for the worst step, which the next state may have used up: none of its
actions might be allowed. The remainder has a bound that shrinks with the action, though:
cos(phi + e) <= cos(phi) - e sin(phi) + e^2/2. So the end point stays before the wall if

    sum_k l_k (e_k^2/2 - e_k sin(phi_k)) <= gap,

which is convex: a ball, |sqrt(l) (e - sin(phi))|^2 <= 2 gap + |sqrt(l) sin(phi)|^2. Standing still
is always part of it, and so is every part of a step, so that no wall is hit between two steps.
"""

import argparse

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl import data
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, StepCounter, TransformedEnv
from torchrl.modules import MLP, NormalParamExtractor, ValueOperator
from torchrl.objectives import SoftUpdate

from cnfp_torchrl import GeometryTransform, TaskSpaceBall, constrain_env, make_constrained_actor
from cnfp_torchrl.geometry import ConstraintSet
from cnfp_torchrl.objectives import ConstrainedSACLoss

LINKS = torch.tensor([0.4, 0.4, 0.2])
TARGET = torch.tensor([0.75, 0.4])
WALL, SPEED, DT = 0.7, 0.5, 0.05
# The judge counts in float64 with zero tolerance. float32 rounds positions and speeds by about
# 1e-7: a margin of 1e-4, in m and m/s, is ample for that, and needs to cover nothing else.
MARGIN = 1e-4


class Arm(EnvBase):
    """Arms that observe their links' directions, and are judged by how they truly move."""

    def __init__(self, agents: int) -> None:
        super().__init__(batch_size=[agents])
        shown = {"observation": data.Unbounded([agents, 6]), "cost": data.Unbounded([agents, 2])}
        self.observation_spec = data.Composite(shown, shape=[agents])
        self.action_spec = data.Bounded(-2, 2, [agents, 3])
        self.reward_spec = data.Unbounded([agents, 1])
        self.done_spec = data.Binary(1, [agents, 1], dtype=torch.bool)
        self.constraint_names, self.angles = ("speed", "wall"), np.zeros((agents, 3))

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        fresh = (torch.tensor([1.6, -1.0, -1.0]) + torch.rand(*self.batch_size, 3) * 1.5).numpy()
        again = None if tensordict is None else tensordict.get("_reset", None)
        self.angles = fresh if again is None else np.where(again.numpy(), fresh, self.angles)
        return self._observed(np.zeros((*self.batch_size, 2)))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        velocity = tensordict["action"].double().numpy()
        speed = np.abs((self.links() * 1j * velocity.cumsum(-1)).sum(-1))
        self.angles = self.angles + DT * velocity
        end = self.links().sum(-1)
        step = self._observed(np.stack([speed > SPEED, end.real > WALL], axis=-1))
        away = torch.from_numpy(np.abs(end - complex(*TARGET.tolist()))).float().unsqueeze(-1)
        return step.update({"reward": -away, "done": torch.zeros_like(away, dtype=torch.bool)})

    def links(self) -> np.ndarray:
        """Return the links as complex numbers in float64, ``(agents, 3)``."""
        return LINKS.double().numpy() * np.exp(1j * self.angles.cumsum(-1))

    def _observed(self, cost: np.ndarray) -> TensorDict:
        directions = torch.from_numpy(self.angles.cumsum(-1))
        observation = torch.cat([directions.cos(), directions.sin()], dim=-1).float()
        shown = {"observation": observation, "cost": torch.from_numpy(cost).float()}
        return TensorDict(shown, self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        torch.manual_seed(seed or 0)


class Speed(GeometryTransform):
    """The end point's speed, |J a|; column i of J sums the links that joint i moves."""

    def constraint_set(self, tensordict: TensorDictBase) -> TaskSpaceBall:
        """Return the joint velocities that move the end point slowly enough."""
        cos, sin = tensordict["observation"].chunk(2, dim=-1)
        moves = torch.stack([-LINKS * sin, LINKS * cos], dim=-2)
        jacobian = moves.flip(-1).cumsum(-1).flip(-1)
        limit = torch.full_like(cos[..., 0], SPEED - MARGIN)
        return TaskSpaceBall(jacobian, torch.zeros_like(cos[..., :2]), limit, validate_args=False)


class Wall(GeometryTransform):
    """The steps that end before the wall, derived above."""

    def constraint_set(self, tensordict: TensorDictBase) -> TaskSpaceBall:
        """Return the joint velocities that surely keep the end point before the wall."""
        cos, sin = tensordict["observation"].chunk(2, dim=-1)
        gap = (WALL - MARGIN - (LINKS * cos).sum(-1)).clamp(min=0)  # rounded, it may be -1e-7
        root = LINKS.sqrt()
        turn = (DT * root.unsqueeze(-1) * torch.ones(3, 3).tril()).expand(*gap.shape, 3, 3)
        radius = (2 * gap + (LINKS * sin**2).sum(-1)).sqrt()
        return TaskSpaceBall(turn, -root * sin, radius, validate_args=False)

    def safe_action(self, tensordict: TensorDictBase, allowed: ConstraintSet) -> Tensor:
        """Return a slow turn of all links from the wall, e = sin(phi)/100: inside both limits."""
        sin = tensordict["observation"][..., 3:]
        return torch.diff(sin, dim=-1, prepend=torch.zeros_like(sin[..., :1])) / (100 * DT)


def main() -> None:
    """Train by SAC and print what the judge counted."""
    parser = argparse.ArgumentParser(description="SAC on an arm with a wall and a speed limit.")
    parser.add_argument("--steps", type=int, default=4000, help="environment steps")
    parser.add_argument("--unsafe", action="store_true", help="leave both limits out")
    given = parser.parse_args()
    torch.manual_seed(0)
    env = constrain_env(TransformedEnv(Arm(16), StepCounter(100)), Speed("speed"), Wall("wall"))
    network = nn.Sequential(MLP(6, 6, num_cells=[64, 64]), NormalParamExtractor())
    flow = "unconstrained" if given.unsafe else "exact"
    actor = make_constrained_actor(network, env, flow=flow)
    critic = ValueOperator(MLP(9, 1, num_cells=[64, 64]), in_keys=["observation", "action"])
    loss = ConstrainedSACLoss(actor, critic, alpha_init=0.05)  # rewards are of this size
    target = SoftUpdate(loss, tau=0.005)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    storage = data.LazyTensorStorage(given.steps + 128)
    buffer = data.TensorDictReplayBuffer(storage=storage, batch_size=128)
    options = {"frames_per_batch": 128, "total_frames": given.steps}
    for batch in Collector(env, actor, auto_register_policy_transforms=False, **options):
        buffer.extend(batch.reshape(-1))
        for _ in range(32):
            losses = loss(buffer.sample())
            optimizer.zero_grad()
            (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).backward()
            optimizer.step()
            target.step()
    steps = buffer[:]
    away = -steps["next", "reward"]
    print(f"{away[-1600:].mean():.3f} m to the target in the end, {away.min():.3f} m at best")
    for name, count in zip(env.constraint_names, steps["next", "cost"].sum(0), strict=True):
        print(f"{name}: {count:.0f} violations in {len(steps)} steps")


if __name__ == "__main__":
    main()
