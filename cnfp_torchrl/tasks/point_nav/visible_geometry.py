r"""The allowed moves of point navigation without the paper's box: everything in sight.

**What is guaranteed.** No move touches an obstacle, on any layout and from every position outside
the rectangles. The battery's guarantee (`cnfp_torchrl.tasks.point_nav.geometry`) holds on layouts
where the nearest station is in sight from everywhere, as on the reference layout: a move that the
battery's ball allows ends at a place from which the nearest station is within reach. On others the
box keeps the way open, which the visible region does not.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

from cnfp_torchrl.geometry import VisibleOrBox, VisibleRegion
from cnfp_torchrl.tasks.point_nav.geometry import ObstacleGeometry, PointNavGeometry
from cnfp_torchrl.tasks.point_nav.layout import Layout
from cnfp_torchrl.tasks.point_nav.shortest_path import MARGIN


class VisibleObstacleGeometry(PointNavGeometry):
    """All moves whose straight way touches no obstacle: not convex, and less timid than a box.

    Rectangles and walls are grown by `MARGIN`. Where that leaves no room around the agent, because
    it is pressed against an obstacle, the box of `ObstacleGeometry` takes the region's place: it
    may leave out the zero action and so leads away.
    """

    usual_name = "obstacle"

    def __init__(
        self,
        layout: Layout | None = None,
        name: str | None = None,
        observation_key: str = "observation",
    ) -> None:
        super().__init__(layout, name, observation_key)
        self._box = ObstacleGeometry(layout, name, observation_key)
        wall = torch.full((2,), self.layout.wall - MARGIN)
        corners = torch.tensor(self.layout.rectangles).reshape(-1, 2, 2)
        grown = corners + MARGIN * torch.tensor([[-1.0], [1.0]])
        self.register_buffer("_obstacles", torch.cat([grown, VisibleRegion.walls(-wall, wall)]))

    def constraint_set(self, tensordict: TensorDictBase) -> VisibleOrBox:
        """Return the moves in sight, or the box (docs/method.md, section 4)."""
        position, _ = self.read(tensordict)
        obstacles = self._obstacles.expand(*position.shape[:-1], *self._obstacles.shape)
        step = torch.full_like(position[..., 0], self.layout.step_length)
        region = VisibleRegion(position, obstacles, step, validate_args=False)
        room = region.slack(torch.zeros_like(position)) >= MARGIN / self.layout.step_length
        return VisibleOrBox(
            **region.fields(),
            **self._box.constraint_set(tensordict).fields(),
            in_sight=room.to(position.dtype),
            validate_args=False,
        )
