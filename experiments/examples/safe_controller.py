r"""A network that corrects a controller, trained through a layer that keeps both of them safe.

    python experiments/examples/safe_controller.py [--steps 200]

No reinforcement learning, no environment: robots move at x' = u, with u in [-2, 2]^2, from the left
to a goal on the right. A disc of radius 1 around 0 lies between. The nominal controller drives
straight to the goal, and would be stuck before the disc for ever, wherever it is headed through it.
The network adds a correction, and learns it by gradients through 60 steps of the motion.

What keeps a robot out of the disc is a barrier, h(x) = |x|^2 - 1, of which each step must leave
half: 2 dt x.u >= -h(x)/2. That is one half-space of actions, and it suffices, since
h(x + dt u) = h(x) + 2 dt x.u + dt^2 |u|^2 >= h(x)/2. Driving straight away from the disc is
strictly inside: a known anchor, so that nothing has to be searched for.
"""

import argparse

import torch
from torch import Tensor, nn

from cnfp_torchrl import Box, HalfSpaces, Region
from cnfp_torchrl.modules import ConstraintLayer

DT = 0.05
GOAL = torch.tensor([2.0, 0.1])
BOUNDS = Box(-2 * torch.ones(2), 2 * torch.ones(2))


def nominal(x: Tensor) -> Tensor:
    """Return the velocity straight to the goal."""
    return 2 * (GOAL - x)


def region(x: Tensor) -> Region:
    """Return the allowed velocities at positions ``(n, 2)``."""
    distance = x.norm(dim=-1, keepdim=True)
    barrier = distance**2 - 1
    rows = HalfSpaces((-2 * x).unsqueeze(-2), 0.5 * barrier / DT, validate_args=False)
    return Region((BOUNDS, rows), anchor=x / distance)


def drive(start: Tensor, layer: ConstraintLayer, network: nn.Module | None) -> Tensor:
    """Return positions ``(61, n, 2)`` of robots that start side by side."""
    x, path = start, [start]
    for _ in range(60):
        correction = torch.zeros_like(x) if network is None else network(x)
        x = x + DT * layer(correction, region(x), nominal(x))
        path.append(x)
    return torch.stack(path)


def starts(count: int) -> Tensor:
    """Return random positions on the left of the disc."""
    return torch.tensor([-2.0, 0.0]) + torch.rand(count, 2) - 0.5


def report(name: str, path: Tensor) -> None:
    """Print how far the robots come, and how often they touch the disc."""
    inside = int((path.double().norm(dim=-1) < 1).sum())
    rest = (path[-1] - GOAL).norm(dim=-1)
    print(f"{name}: {rest.median():.2f} left to the goal, {inside} positions in the disc")


def main() -> None:
    """Train the correction and compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--steps", type=int, default=200, help="of the optimizer")
    arguments = parser.parse_args()
    torch.manual_seed(0)
    layer = ConstraintLayer("soft")
    network = nn.Sequential(nn.Linear(2, 32), nn.Tanh(), nn.Linear(32, 2))
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    for _ in range(arguments.steps):
        path = drive(starts(32), layer, network)
        loss = (path - GOAL).norm(dim=-1).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    test = starts(200)
    with torch.no_grad():
        report("nominal controller, made safe", drive(test, layer, None))
        report("with the trained correction  ", drive(test, layer, network))


if __name__ == "__main__":
    main()
