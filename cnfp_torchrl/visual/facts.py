"""What an environment's state says about its constraints, in sentences."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from cnfp_torchrl.envs import appended_transforms
from cnfp_torchrl.tasks.point_nav import BatteryGeometry
from cnfp_torchrl.tasks.point_nav.geometry import PointNavGeometry, read_observation
from cnfp_torchrl.tasks.point_nav.shortest_path import side_distances


class Facts(NamedTuple):
    """What there is to say about a state.

    Args:
        situation: where the agent is.
        by_constraint: a sentence for each constraint, by its name.
    """

    situation: str
    by_constraint: dict[str, str]


class FactProvider(Protocol):
    """Says what there is to say about a state of batch size ``()``."""

    def __call__(self, state: TensorDictBase) -> Facts: ...


class PointNavFacts:
    """Distances, in arena units and steps, and what the battery still reaches.

    Args:
        geometries: those of the environment's constraints; at least one.
    """

    def __init__(self, geometries: list[PointNavGeometry]) -> None:
        self._geometries = geometries
        self._path = geometries[0].path
        self._key = str(geometries[0].in_keys[0])

    @torch.no_grad()
    def __call__(self, state: TensorDictBase) -> Facts:
        """Return the facts of a state that shows the observation of point navigation."""
        layout = self._path.layout
        position, charge = read_observation(state, self._key)
        goal = state.get(self._key)[..., 3:]
        to_goal = float(torch.linalg.vector_norm(goal - position))
        x, y = position.tolist()
        battery = int(charge)
        situation = (
            f"At ({x:.3f}, {y:.3f}), battery {battery} %, goal {to_goal:.3f} away "
            f"({to_goal / layout.step_length:.1f} steps)."
        )
        said = {
            geometry.name: self._battery(position, battery)
            if isinstance(geometry, BatteryGeometry)
            else self._obstacle(position)
            for geometry in self._geometries
        }
        return Facts(situation, said)

    def _obstacle(self, position: Tensor) -> str:
        layout = self._path.layout
        wall = layout.wall - max(map(abs, position.tolist()))
        said = f"the nearest wall is {_length(wall, layout.step_length)} away."
        if not layout.rectangles:
            return f"No rectangles; {said}"
        outside = side_distances(position, self._path.rectangles).unflatten(-1, (2, 2)).amax(-2)
        distance = float(torch.linalg.vector_norm(outside.clamp(min=0), dim=-1).min())
        if distance == 0:
            return f"The agent touches a rectangle; {said}"
        return f"The nearest rectangle is {_length(distance, layout.step_length)} away, {said}"

    def _battery(self, position: Tensor, battery: int) -> str:
        layout = self._path.layout
        way = self._path.to_station(position)
        length = float(torch.linalg.vector_norm(way.waypoint - position) + way.rest)
        needed = max(math.ceil((length - layout.zone_radius) / layout.step_length), 0)
        left = battery - layout.battery_threshold
        if left < 0:
            said = f"The charge is below the threshold of {layout.battery_threshold} %"
        else:
            said = f"{left} steps are left above {layout.battery_threshold} %"
        if not bool(way.found):
            return f"{said}, and no way to a station was found."
        zone = "in its zone" if needed == 0 else f"{needed} steps to its zone"
        return f"{said}; the way to the nearest station is {length:.3f} long, {zone}."


def facts_of(env: EnvBase | None) -> FactProvider | None:
    """Return what tells the facts of an environment's states, None where nothing is known."""
    known = [] if env is None else appended_transforms(env)
    geometries = [each for each in known if isinstance(each, PointNavGeometry)]
    return PointNavFacts(geometries) if geometries else None


def _length(length: float, step: float) -> str:
    return f"{length:.3f} ({length / step:.1f} steps)"
