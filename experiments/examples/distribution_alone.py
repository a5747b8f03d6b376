"""The distribution alone, no environment: sample, score, integrate, check containment.

python experiments/examples/distribution_alone.py [--samples 100000] [--grid 1000]
"""

import argparse

import torch
from torch.distributions import Independent, Normal

from cnfp_torchrl.bijectors import GaugeSquash
from cnfp_torchrl.distributions import ConstrainedFlow
from cnfp_torchrl.geometry import Ball, Box, HalfSpaces, Region


def main() -> None:
    """Put a Gaussian on the intersection of a box, a ball and a half-space."""
    parser = argparse.ArgumentParser(description="A distribution on an intersection of sets.")
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--grid", type=int, default=1000, help="points of the integral, each way")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)

    bounds = Box(-torch.ones(2), torch.ones(2))
    ball = Ball(torch.tensor([0.8, 0.0]), torch.tensor(0.7))
    below = HalfSpaces(torch.tensor([[-1.0, 2.0]]), torch.tensor([0.2]))  # 2 y - x <= 0.2
    region = Region.build([bounds, ball, below])  # finds an anchor; the last set has priority
    base = Independent(Normal(torch.tensor([0.5, -1.0]), torch.tensor([1.5, 1.0])), 1)
    flow = ConstrainedFlow(base, GaugeSquash(region))

    action, log_prob = flow.rsample_and_log_prob((arguments.samples,))
    x, y = action.double().unbind(-1)
    outside = (x.abs() > 1) | (y.abs() > 1) | ((x - 0.8) ** 2 + y**2 > 0.7**2) | (2 * y - x > 0.2)
    print(f"{int(outside.sum())} of {arguments.samples} samples outside; mode {flow.mode.tolist()}")

    # Two independent numbers each for the volume under the density and for the entropy.
    line = (torch.arange(arguments.grid) + 0.5) / arguments.grid * 2 - 1
    log_density = flow.log_prob(torch.cartesian_prod(line, line))
    density = log_density.exp() * (2 / arguments.grid) ** 2
    entropy = -(density * log_density).nansum()
    print(f"the density integrates to {density.sum():.5f}")
    print(f"entropy {entropy:.3f} by integration, {-log_prob.mean():.3f} by sampling")


if __name__ == "__main__":
    main()
