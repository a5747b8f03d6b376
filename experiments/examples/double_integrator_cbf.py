r"""A double integrator that never crosses a wall, whatever drives it: a discrete-time barrier.

    python experiments/examples/double_integrator_cbf.py [--steps 500] [--unsafe]

The action a in [-1, 1]^2 is an acceleration, held for a step dt: v' = v + dt a and
p' = p + dt (v + v')/2. The wall is the line n.p = 1, and the agents must keep to n.p <= 1. Let
x = 1 - n.p be the gap, s = n.v the speed towards the wall, b = 0.9 |n|_1 a braking that the action
bounds always allow, and D(s) = dt s/2 + s^2/(2b) for s > 0, else 0, a distance in which one can
stop. The barrier is h = x - D(s), and the states with h >= 0 are safe.

What keeps a state safe. A step ends with the speed y = s + dt n.a and the gap
x' = x - dt (s + y)/2. For y >= 0 the new state is safe if and only if y^2/(2b) + dt y <= r with
r = x - dt s/2, which h >= 0 makes non-negative; for y < 0 it always is, since x' >= r. So the
condition is y <= y_max, with the root y_max >= 0 of that quadratic: one half-space of actions,

    n.a <= (y_max - s)/dt.

It always leaves an action. From a safe state, braking by b if s >= dt b leads to the speed
s - dt b, and D falls by dt s while the gap falls by dt s - dt^2 b/2 only; braking by s/dt if
0 < s < dt b leads to y = 0 with the gap x - dt s/2 = r >= 0; and for s <= 0 n.a = 0 will do.

Nor is the wall crossed between two steps: the speed is linear in time, so the gap is smallest at
either end of the step, or, if s > 0 > y, where the speed is 0, which is before the time
dt and so at a gap of at least x - dt s/2 = r >= 0.
"""

import argparse
from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from cnfp_torchrl.envs import GeometryTransform, constrain_env, constraint_bijectors
from cnfp_torchrl.geometry import ConstraintSet, HalfSpaces
from cnfp_torchrl.modules import ConstrainedFlowModule

Control = Callable[[Tensor], tuple[Tensor, Tensor]]
"""From observations ``(agents, 4)`` to location and scale of the latent, ``(agents, 2)``."""

DT = 0.05
NORMAL = torch.tensor([0.6, 0.8])
BRAKING = 0.9 * float(NORMAL.abs().sum())
MARGIN = 1e-3  # to the wall: float32 rounds positions of some hundred units by less


class DoubleIntegrator(EnvBase):
    """Agents at rest before the wall; the reward draws them to a place behind it."""

    def __init__(self, agents: int) -> None:
        super().__init__(batch_size=[agents])
        self.observation_spec = Composite(observation=Unbounded([agents, 4]), shape=[agents])
        self.action_spec = Bounded(-1, 1, [agents, 2])
        self.reward_spec = Unbounded([agents, 1])
        self.done_spec = Binary(1, [agents, 1], dtype=torch.bool)

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        position = -torch.rand(*self.batch_size, 2)
        observation = torch.cat([position, torch.zeros_like(position)], dim=-1)
        return TensorDict({"observation": observation}, self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        position, velocity = tensordict["observation"].chunk(2, dim=-1)
        faster = velocity + DT * tensordict["action"]
        position = position + DT * (velocity + faster) / 2
        reward = -(position - 2 * NORMAL).norm(dim=-1, keepdim=True)
        return TensorDict(
            {
                "observation": torch.cat([position, faster], dim=-1),
                "reward": reward,
                "done": torch.zeros_like(reward, dtype=torch.bool),
            },
            self.batch_size,
        )

    def _set_seed(self, seed: int | None) -> None:
        torch.manual_seed(seed or 0)


class Barrier(GeometryTransform):
    """The half-space of accelerations that keep the state safe."""

    def constraint_set(self, tensordict: TensorDictBase) -> HalfSpaces:
        """Return the half-space, derived above."""
        position, velocity = tensordict["observation"].chunk(2, dim=-1)
        speed = velocity @ NORMAL
        room = (1 - MARGIN - position @ NORMAL - DT * speed / 2).clamp(min=0)
        # The positive root of y^2/(2b) + dt y = room, in the form that does not cancel.
        fastest = 2 * room / (DT + (DT**2 + 2 * room / BRAKING).sqrt())
        offset = ((fastest - speed) / DT).unsqueeze(-1)
        return HalfSpaces(NORMAL.expand(*offset.shape, 2), offset, validate_args=False)

    def safe_action(self, tensordict: TensorDictBase, allowed: ConstraintSet) -> Tensor:
        """Return a braking between the one that plans count on and the strongest."""
        return -0.95 * NORMAL.sign().expand(*tensordict.shape, 2)


def push(observation: Tensor) -> tuple[Tensor, Tensor]:
    """Push at the wall and about, each agent with its own force, from gentle to absurd."""
    force = torch.logspace(-2, 6, len(observation)).unsqueeze(-1)
    return force * (NORMAL + torch.randn(len(observation), 2)), force


def run(control: Control, *, steps: int, agents: int, unsafe: bool = False) -> TensorDictBase:
    """Return the agents' steps under a control, ``(agents, steps)``."""
    env = constrain_env(DoubleIntegrator(agents), Barrier("wall"))
    actor = TensorDictSequential(
        TensorDictModule(control, in_keys=["observation"], out_keys=["loc", "scale"]),
        ConstrainedFlowModule(
            env.action_spec_unbatched,
            constraint_bijectors(env),
            flow="unconstrained" if unsafe else "exact",
        ),
    )
    return env.rollout(steps, actor)


def main() -> None:
    """Drive the agents at the wall and count those that cross it."""
    parser = argparse.ArgumentParser(description="A control barrier on a double integrator.")
    parser.add_argument("--steps", type=int, default=500, help="of each agent")
    parser.add_argument("--agents", type=int, default=256, help="that act in parallel")
    parser.add_argument("--unsafe", action="store_true", help="leave the barrier out")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)

    steps = run(push, steps=arguments.steps, agents=arguments.agents, unsafe=arguments.unsafe)
    position = steps["next", "observation"][..., :2].double()
    gap = 1 - position @ NORMAL.double()
    print(f"{int((gap < 0).any(-1).sum())} of {arguments.agents} agents crossed the wall")
    print(f"nearest approach {gap.min():.4f}, {int((gap < 0).sum())} of {gap.numel()} steps beyond")


if __name__ == "__main__":
    main()
