"""The view of point navigation: its map, the battery, distances in steps, and telling states."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.linalg import vector_norm
from torchrl.envs import EnvBase

from cnfp_torchrl.envs import (
    Boxes,
    Component,
    Discs,
    Map,
    Marks,
    Polyline,
    Series,
    TaskView,
    appended_transforms,
)
from cnfp_torchrl.tasks.point_nav.geometry import (
    BatteryGeometry,
    PointNavGeometry,
    read_observation,
)
from cnfp_torchrl.tasks.point_nav.layout import BATTERY_FULL, Layout
from cnfp_torchrl.tasks.point_nav.shortest_path import ShortestPath, side_distances

_CANDIDATES = 1024
"""At least so many states are drawn to choose a permissive and a restrictive one from."""

_MOST_RESETS = 64
_LOW = 30
"""Charges of up to this much above the battery's threshold are low, in percent."""


class PointNavView(TaskView):
    """Map, distances in arena units and steps, and what the battery still reaches.

    Args:
        layout: The map.
        env: The environment as it is used; the geometries among its transforms say what the
            constraints are called, and which observation they read.
    """

    def __init__(self, layout: Layout, env: EnvBase) -> None:
        appended = appended_transforms(env)
        self._geometries = [t for t in appended if isinstance(t, PointNavGeometry)]
        self._key = str(self._geometries[0].in_keys[0]) if self._geometries else "observation"
        self._layout = layout
        self.map = _map(layout)
        self.series = [Series("battery", "%", layout.battery_threshold, (0, BATTERY_FULL))]
        self.position_keys = [self._key]
        self.action_components = [Component("right"), Component("up")]
        self.observation_components = [
            Component("x", "arena units"),
            Component("y", "arena units"),
            Component("battery / 100"),
            Component("goal x", "arena units"),
            Component("goal y", "arena units"),
        ]
        self.state_setter = set_state

    @cached_property
    def _path(self) -> ShortestPath:
        return self._geometries[0].path if self._geometries else ShortestPath(self._layout)

    def position(self, states: TensorDictBase) -> Tensor:
        return states.get(self._key)[..., :2]

    def goal(self, states: TensorDictBase) -> Tensor:
        return states.get(self._key)[..., 3:]

    def series_values(self, states: TensorDictBase) -> Mapping[str, Tensor]:
        return {"battery": BATTERY_FULL * states.get(self._key)[..., 2].double()}

    def situation(self, state: TensorDictBase) -> str:
        position, charge = read_observation(state, self._key)
        to_goal = float(vector_norm(self.goal(state) - position))
        x, y = position.tolist()
        return (
            f"At ({x:.3f}, {y:.3f}) arena units, battery {int(charge)} %, goal {to_goal:.3f} arena "
            f"units away ({to_goal / self._layout.step_length:.1f} steps)."
        )

    @torch.no_grad()
    def constraint_sentences(self, state: TensorDictBase) -> Mapping[str, str]:
        position, charge = read_observation(state, self._key)
        return {
            geometry.name: self._battery(position, int(charge))
            if isinstance(geometry, BatteryGeometry)
            else self._obstacle(position)
            for geometry in self._geometries
        }

    def candidate_states(self, env: EnvBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Return states with a full battery anywhere, and low ones close beside rectangles."""
        layout = self._layout
        generator = torch.Generator().manual_seed(0)
        shape = env.batch_size
        lowest = layout.battery_threshold + 1
        highest = min(layout.battery_threshold + _LOW, BATTERY_FULL)
        full, low = [], []
        for _ in range(min(-(-_CANDIDATES // shape.numel()), _MOST_RESETS)):
            charge = torch.randint(lowest, highest + 1, shape, generator=generator)
            beside = _beside_rectangles(layout, shape, generator) if layout.rectangles else None
            full.append(env.reset(battery=BATTERY_FULL))
            low.append(env.reset(battery=charge, position=beside))
        permissive: TensorDictBase = torch.stack(full).reshape(-1)
        # The first of equally permissive states is taken: let it be far from everything.
        far = _clearance(layout, self.position(permissive)).argsort(descending=True)
        return permissive[far], torch.stack(low).reshape(-1)

    def _obstacle(self, position: Tensor) -> str:
        layout = self._layout
        wall = layout.wall - max(map(abs, position.tolist()))
        nearest = f"the nearest wall is {_length(wall, layout.step_length)} away."
        if not layout.rectangles:
            return f"No rectangles; {nearest}"
        outside = side_distances(position, self._path.rectangles).unflatten(-1, (2, 2)).amax(-2)
        distance = float(vector_norm(outside.clamp(min=0), dim=-1).min())
        if distance == 0:
            return f"The agent touches a rectangle; {nearest}"
        return f"The nearest rectangle is {_length(distance, layout.step_length)} away, {nearest}"

    def _battery(self, position: Tensor, battery: int) -> str:
        layout = self._layout
        way = self._path.to_station(position)
        length = float(vector_norm(way.waypoint - position) + way.rest)
        needed = max(math.ceil((length - layout.zone_radius) / layout.step_length), 0)
        left = battery - layout.battery_threshold
        if left < 0:
            charge = f"The charge is below the threshold of {layout.battery_threshold} %"
        else:
            steps = "1 step is" if left == 1 else f"{left} steps are"
            charge = f"{steps} left above {layout.battery_threshold} %"
        if not bool(way.found):
            return f"{charge}, and no way to a station was found."
        zone = f"{_steps(needed)} to its zone" if needed else "in its zone"
        return f"{charge}; the way to the nearest station is {length:.3f} arena units long, {zone}."


def set_state(env: EnvBase, states: TensorDictBase) -> TensorDictBase:
    """Put point navigation into the states that observations show."""
    position, battery = read_observation(states, "observation")
    return env.reset(position=position, battery=battery, goal=states["observation"][..., 3:])


def _map(layout: Layout) -> Map:
    wall, limits = layout.wall, (-layout.wall, layout.wall)
    corners = ((-wall, -wall), (wall, -wall), (wall, wall), (-wall, wall), (-wall, -wall))
    return Map(
        limits,
        limits,
        "arena units",
        (
            Polyline(name="walls", points=corners, color_on_dark="#787A87"),
            Boxes(
                name="rectangles",
                boxes=layout.rectangles,
                color_on_dark="#545662",
                label="obstacle",
            ),
            Discs(
                name="stations/zones",
                centers=layout.stations,
                radius=layout.zone_radius,
                color="#CDEBE1",
                color_on_dark="#0E3E34",
                label="zone of a station",
            ),
            Marks(name="stations/places", points=layout.stations, color="#009E73", label="station"),
        ),
        layout.step_length,
        layout.goal_radius,
    )


def _clearance(layout: Layout, position: Tensor) -> Tensor:
    """Return the distance to the nearest rectangle or wall along an axis, ``(n,)``."""
    clearance = layout.wall - position.abs().amax(-1)
    for rectangle in layout.rectangles:
        low, high = torch.tensor(rectangle).to(position).split(2)
        outside = torch.maximum(low - position, position - high).amax(-1)
        clearance = torch.minimum(clearance, outside)
    return clearance


def _beside_rectangles(layout: Layout, shape: torch.Size, generator: torch.Generator) -> Tensor:
    """Return positions at up to 0.8 steps from a rectangle, ``(*shape, 2)``."""

    def uniform(*size: int) -> Tensor:
        return torch.rand(*shape, *size, generator=generator)

    chosen = torch.randint(len(layout.rectangles), shape, generator=generator)
    low, high = torch.tensor(layout.rectangles)[chosen].split(2, dim=-1)
    margin = layout.step_length * (0.1 + 0.7 * uniform(1))
    low, high = low - margin, high + margin
    position = low + (high - low) * uniform(2)
    # Push one component, either, onto either side of the grown rectangle.
    upper = (uniform(1) < 0.5).expand_as(position)
    on_first = uniform(1) < 0.5
    pushed = torch.cat([on_first, ~on_first], dim=-1)
    position = torch.where(pushed, torch.where(upper, high, low), position)
    return position.clamp(-layout.wall, layout.wall)


def _length(length: float, step: float) -> str:
    return f"{length:.3f} arena units ({length / step:.1f} steps)"


def _steps(count: int) -> str:
    return "1 step" if count == 1 else f"{count} steps"
