"""Draw the front page's picture of a flow: `python experiments/figures/banner.py OUT.png`."""

import sys
from pathlib import Path

import torch
from torch import Tensor, nn

from cnfp_torchrl.modules import make_constrained_actor
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, Layout, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.training.environment import make_environment
from cnfp_torchrl.visual import take_snapshot
from cnfp_torchrl.visual.banner import flow_banner
from cnfp_torchrl.visual.canvas import save_png

ORDER = ["battery", "obstacle"]
LAYOUT = Layout(
    rectangles=((-0.6, -0.6, -0.2, -0.3), (0.1, -0.2, 0.5, 0.5), (-0.5, 0.2, -0.3, 0.8)),
    stations=((-0.9, 0.0), (0.8, 0.8)),
)
# Beside a rectangle, at its corner, with just enough charge to reach the station.
POSITION, BATTERY, GOAL = (0.47, -0.22), 34, (0.6, 0.2)
DPI = 116


class StandardNormal(nn.Module):
    """The base of a network that has learned nothing yet."""

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return location 0 and scale 1."""
        shape = (*observation.shape[:-1], 2)
        return torch.zeros(shape), torch.ones(shape)


def main(path: Path) -> None:
    """Draw an untrained policy in a state where both constraints bind."""
    env = make_environment(
        PointNavEnv(layout=LAYOUT, seed=0),
        {
            "battery": BatteryGeometry(LAYOUT, "battery"),
            "obstacle": ObstacleGeometry(LAYOUT, "obstacle"),
        },
        order=ORDER,
        with_anchor=True,
    )
    actor = make_constrained_actor(StandardNormal(), env)
    state = env.reset(position=POSITION, battery=BATTERY, goal=GOAL)
    snapshot = take_snapshot(actor, state, samples=700)
    save_png(flow_banner(snapshot, LAYOUT), path, dpi=DPI)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python experiments/figures/banner.py OUT.png")
    main(Path(sys.argv[1]))
