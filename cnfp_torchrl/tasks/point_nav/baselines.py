"""Policies that learn nothing, to compare learned ones with."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from cnfp_torchrl.modules import ConstrainedFlowModule
from cnfp_torchrl.tasks.point_nav.layout import Layout
from cnfp_torchrl.tasks.point_nav.shortest_path import ShortestPath


class ShortestPathPolicy(TensorDictModuleBase):
    """Full speed along the shortest path to the goal, pushed into the allowed region.

    Args:
        head: The flow module of an actor, which knows the region.
        layout: The map; None takes the reference task.
    """

    def __init__(self, head: ConstrainedFlowModule, layout: Layout | None = None) -> None:
        super().__init__()
        self.head = head
        self.path = ShortestPath(layout)
        self.in_keys = ["observation", *head.geometry_keys()]
        self.out_keys = [head.action_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action towards the next waypoint on the way to the goal."""
        observation = tensordict.get("observation")
        position, goal = observation[..., :2], observation[..., 3:]
        waypoint = self.path.to_goal(position, goal)
        move = (waypoint - position) / self.path.layout.step_length
        move = move / move.norm(dim=-1, keepdim=True).clamp(min=1)
        allowed = self.head.get_region(tensordict).eroded().pulled_in(move)
        return tensordict.set(self.head.action_key, allowed)
