r"""The allowed actions of point navigation: a box for the obstacles, a ball for the battery.

`VisibleObstacleGeometry` replaces the box by all moves in sight. All read the observation only, so
that they work on any environment that shows it, and count in action units, the displacement divided
by the step length.

**What is guaranteed.** Let n be the charge before a step, and let

.. math:: reach(n) = 0.9\, zone + 0.9\, step\, (n - 1 - threshold)

be what the battery still allows after it, planned with a cautious speed. Let D(p) be the length of
the way to the nearest station by `ShortestPath`, its turns charged. The two sets together keep

.. math:: D(p) \le reach(n + 1),\quad \text{p outside all rectangles}

from one step to the next for every allowed action, and leave an action open in every such state: 0
violations at any time. On the reference layout every start is such a state, the way is the straight
line to the nearest station, and a move along it lies at least 0.04 action units inside both sets.
On other layouts it holds from starts with that property, where passages are wider than twice the
clearance of `ShortestPath`. The obstacle's part alone holds from every position outside the
rectangles.

With all moves in sight instead of the box, the obstacle's part holds on any layout. The battery's
part holds where the nearest station is in sight from everywhere, as on the reference layout: a move
that the battery's ball allows ends where the nearest station is within reach. On other layouts the
box keeps the way open, which the visible region does not.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple
from weakref import ref

import torch
from tensordict import TensorDictBase
from torch import Tensor

from cnfp_torchrl.envs import GeometryTransform
from cnfp_torchrl.geometry import Ball, Box, GeometryError, VisibleRegion
from cnfp_torchrl.tasks.point_nav.layout import BATTERY_FULL, Layout
from cnfp_torchrl.tasks.point_nav.shortest_path import (
    CAUTIOUS,
    MARGIN,
    ShortestPath,
    StationWay,
)

_BEYOND = 2.0
"""Sets for states in which no action keeps the constraint begin here, outside the bounds of 1."""


class PointNavGeometry(GeometryTransform):
    """A constraint of point navigation: reads position and charge, knows the map.

    Args:
        layout: The map; None takes the reference task.
        name: The constraint's name; None takes the usual one.
        observation_key: The key of the observation ``(*batch, 5)``, which must not be rescaled.
        kwargs: Further options of `GeometryTransform`: ``margin`` and ``resolution``.
    """

    usual_name: ClassVar[str]

    def __init__(
        self,
        layout: Layout | None = None,
        name: str | None = None,
        observation_key: str = "observation",
        **kwargs: Any,
    ) -> None:
        super().__init__(self.usual_name if name is None else name, [observation_key], **kwargs)
        self.path = ShortestPath(layout)
        self.layout = self.path.layout

    def read(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return `read_observation` of the states."""
        return read_observation(tensordict, self.in_keys[0])

    def way(self, tensordict: TensorDictBase) -> StationWay:
        """Return the way to the nearest station, which both constraints of a state ask for."""
        global _last_way
        observation, layout = tensordict.get(self.in_keys[0]), self.layout
        if torch.compiler.is_compiling():
            return self.path.to_station(read_position(tensordict, self.in_keys[0]))
        known = _last_way
        if known is not None and known.is_of(observation, layout):
            return known.way
        way = self.path.to_station(read_position(tensordict, self.in_keys[0]))
        if not observation.is_inference():
            _last_way = _KnownWay(ref(observation), observation._version, layout, way)
        return way


class _KnownWay(NamedTuple):
    """The ways of the observation that was looked at last, as long as it is unchanged."""

    observation: ref[Tensor]
    version: int
    layout: Layout
    way: StationWay

    def is_of(self, observation: Tensor, layout: Layout) -> bool:
        """Tell whether the ways are those of an observation."""
        same = self.observation() is observation and self.version == observation._version
        return same and self.layout == layout


_last_way: _KnownWay | None = None


class ObstacleGeometry(PointNavGeometry):
    """A box of moves that touch no obstacle and keep the way to the nearest station open.

    For each rectangle the box stays on the outer side of one of its four edges, prolonged: the
    farthest of those that separate the rectangle from the agent and from the next waypoint. Bounds
    keep `MARGIN` from edges and walls and are clipped at the action bounds. They are not clamped to
    contain 0: an agent that rounding left just inside the margin is pushed back.

    Where no move keeps the constraint (the agent touches a rectangle, or is out of reach of the
    arena) the box lies beyond the action bounds, in [2, 3] on the axis of the shortest way out.
    """

    usual_name = "obstacle"

    def constraint_set(self, tensordict: TensorDictBase) -> Box:
        """Return the box of allowed moves (docs/method.md, section 4)."""
        way = self.way(tensordict)
        distance = way.side_distances
        separates = way.separating.amax(1, keepdim=True) > 0
        eligible = torch.where(separates, way.separating, distance) - self.path.precedence
        # No room is left beside a rectangle that is touched, and any beyond the other sides of it.
        # By sums, as masks take many times as long.
        free = torch.nn.functional.threshold(distance, 0.0, -2 * self.layout.wall)
        free = torch.add(free, eligible.amax(1, keepdim=True) - eligible, alpha=1e30)
        # All sides of the arena count.
        rooms = torch.cat([free, way.wall_distances])
        # Of high bounds, then of low ones with their signs changed.
        room = ((rooms.amin(0) - MARGIN) / self.layout.step_length).view(2, 2, -1)
        bounds = room.clamp(-1, 1)
        above, below = room.unbind()
        outwards = (above >= below) * (1 + 2 * _BEYOND) - _BEYOND
        outwards = torch.stack([outwards, 1 - outwards])
        bounds = torch.where(bounds.sum(0) <= 0, outwards, bounds)
        high, low = bounds.mT.reshape(2, *way.batch, 2).contiguous().unbind()
        return Box(-low, high, validate_args=False)


class VisibleObstacleGeometry(PointNavGeometry):
    """All moves whose straight path touches no obstacle: not convex, and larger than a box.

    Without the margin of `ObstacleGeometry`: flows keep off by what rounding may do, and lead an
    agent that is so close away, see `VisibleRegion.eroded`. A visible region cannot be moved
    inwards: a margin or a resolution is refused, by name, when the environment's specs are read.
    """

    usual_name = "obstacle"

    def __init__(
        self,
        layout: Layout | None = None,
        name: str | None = None,
        observation_key: str = "observation",
        **kwargs: Any,
    ) -> None:
        super().__init__(layout, name, observation_key, **kwargs)
        # From the next number on: an agent may stand on a wall, not on an edge of a rectangle.
        wall = torch.nextafter(torch.full((2,), self.layout.wall), torch.tensor(torch.inf))
        rectangles = torch.tensor(self.layout.rectangles).reshape(-1, 2, 2)
        self.register_buffer(
            "_obstacles", torch.cat([rectangles, VisibleRegion.walls(-wall, wall)])
        )

    def constraint_set(self, tensordict: TensorDictBase) -> VisibleRegion:
        """Return the moves in sight (docs/method.md, section 4)."""
        position = read_position(tensordict, self.in_keys[0])
        obstacles = self._obstacles.expand(*position.shape[:-1], *self._obstacles.shape)
        step = torch.full_like(position[..., 0], self.layout.step_length)
        return VisibleRegion(position, obstacles, step, validate_args=False)


class BatteryGeometry(PointNavGeometry):
    r"""The ball of moves after which the battery still reaches a station, around the next waypoint.

    Its radius is :math:`reach(n) - rest`: :math:`reach(n)` as in the module's docstring, rest the
    length of the way beyond the waypoint. At a waypoint that is no station it is at least the
    turning radius. The ball is huge when the battery is full, and closes in on the station as the
    battery empties.

    Where no move keeps the constraint (the charge is at the threshold or below) the ball lies
    beyond the action bounds, in the direction of the waypoint. Where the station is out of reach,
    the ball misses the bounds as it is.
    """

    usual_name = "battery"

    def constraint_set(self, tensordict: TensorDictBase) -> Ball:
        """Return the ball of allowed moves (docs/method.md, section 4)."""
        way, step = self.way(tensordict), self.layout.step_length
        position = read_position(tensordict, self.in_keys[0])
        battery = _read_charge(tensordict, self.in_keys[0]).reshape(-1)
        rest, turning_radius = (way.beyond / step).unbind()
        # What the battery allows after this step, in action units.
        reach = CAUTIOUS * (battery - 1 - self.layout.battery_threshold)
        reach = reach + CAUTIOUS * self.layout.zone_radius / step
        radius = torch.maximum(reach - rest, turning_radius)
        # At the waypoint itself any direction leads to it; squares of this one are in range.
        center = (way.corner - position.reshape(-1, 2).mT) / step + 1e-18

        lost = battery <= self.layout.battery_threshold
        # Radius 1, and sqrt(2) to the corner of the action bounds: at 2 + 2 they do not meet.
        beyond = (_BEYOND + 2) * center.square().sum(0).rsqrt()
        center = center * torch.where(lost, beyond, torch.ones_like(beyond))
        return Ball(
            center.mT.reshape(*way.batch, 2).contiguous(),
            radius.masked_fill(lost, 1).view(way.batch),
            validate_args=False,
        )


def read_observation(tensordict: TensorDictBase, key: str) -> tuple[Tensor, Tensor]:
    """Return positions ``(*batch, 2)`` and charges in whole percent, int64 ``(*batch,)``."""
    return read_position(tensordict, key), _read_charge(tensordict, key).to(torch.int64)


def _read_charge(tensordict: TensorDictBase, key: str) -> Tensor:
    """Return charges in whole percent, ``(*batch,)``."""
    return (tensordict.get(key)[..., 2] * BATTERY_FULL).round()


def read_position(tensordict: TensorDictBase, key: str) -> Tensor:
    """Return positions ``(*batch, 2)``."""
    observation = tensordict.get(key)
    if observation.shape[-1] != 5:
        raise GeometryError(
            f"key {key!r}: expected (x, y, battery / {BATTERY_FULL}, goal x, goal y), shape "
            f"(*batch, 5), given shape {tuple(observation.shape)}"
        )
    return observation[..., :2]
