r"""Shortest paths around the rectangles: to the nearest station, and to a goal.

The two use two relations between points.

*Separable*: for each rectangle one of its four sides, prolonged to a line, has both points on its
outer side. Then so has every point of any axis-parallel box that keeps to these sides, and it sees
what the agent saw. The way to a station uses this relation, because the sets of allowed actions are
built on it (`ObstacleGeometry`). Its nodes are the stations and the crossings of all rectangle
edges, moved outwards by a clearance, and of the walls, moved inwards: every point of free space
lies in a cell of that grid and is separable from the cell's corners.

*Visible*: the straight segment crosses no rectangle. The way to a goal uses it.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import embedding

from cnfp_torchrl.tasks.point_nav.layout import Layout

CAUTIOUS = 0.9
"""The share of a step's length, and of a zone's radius, that plans count on."""

MARGIN = 1e-4
"""The distance from walls and rectangles that allowed actions keep, in arena units."""

_TOLERANCE = 1e-9


class StationWay(NamedTuple):
    """The way from a position to the station that is nearest along it."""

    waypoint: Tensor
    """The next point to go to straight, ``(*batch, 2)``: a node of the grid or the station."""
    rest: Tensor
    """What remains beyond the waypoint, its turn included; 0 at a station; ``(*batch,)``."""
    turning_radius: Tensor
    """The distance from the waypoint within which all is visible that is visible from it; 0 at a
    station; ``(*batch,)``."""
    separates: Tensor
    """Which sides (x_low, y_low, x_high, y_high) of each rectangle separate it from both the
    position and the waypoint, bool ``(*batch, R, 4)``; all false where no way was found."""
    side_distances: Tensor
    """The position's `side_distances`, ``(*batch, R, 4)``."""
    found: Tensor
    """False inside rectangles and where no separable way exists, bool ``(*batch,)``; the waypoint
    is then the station nearest in a straight line."""


class ShortestPath(nn.Module):
    r"""The next waypoints on a layout: graphs are computed once, queries are batched.

    Lengths are in arena units. A turn at a node is charged ``CAUTIOUS * step_length`` plus the
    turning radius on the way to a station: the step that ends at the node may be cut short by that
    much. The battery's guarantee rests on this charge.

    Passages narrower than twice the clearance are not used.

    Args:
        layout: The map; None takes the reference task.
        clearance: The distance of nodes from rectangles and walls; None takes a fifth of a step.

    Raises:
        ValueError: when the clearance is not greater than `MARGIN`.
    """

    rectangles: Tensor
    nodes: Tensor
    node_rest: Tensor
    node_turning_radius: Tensor
    node_clear: Tensor
    node_detours: Tensor
    side_codes: Tensor
    first_rows: Tensor
    corners: Tensor
    corner_lengths: Tensor

    def __init__(self, layout: Layout | None = None, *, clearance: float | None = None) -> None:
        super().__init__()
        self.layout = Layout() if layout is None else layout
        self.clearance = 0.2 * self.layout.step_length if clearance is None else clearance
        if not self.clearance > MARGIN:
            raise ValueError(f"clearance: expected more than {MARGIN}, given {self.clearance}")
        for name, value in (*self._station_graph(), *self._goal_graph()):
            value = value.float() if value.is_floating_point() else value
            self.register_buffer(name, value, persistent=False)

    def to_station(self, position: Tensor) -> StationWay:
        """Return the way to the nearest station from positions ``(*batch, 2)``."""
        distances = side_distances(position, self.rectangles)
        outside = distances > 0
        # The sides that a rectangle is seen from tell which nodes are separable from it: looked up,
        # not compared side by side with each node.
        seen_from = (outside * self.side_codes).sum(-1) + self.first_rows
        detours = embedding(seen_from, self.node_detours).sum(-2)
        x, y = position.unsqueeze(-2).unbind(-1)
        distance = torch.hypot(x - self.nodes[:, 0], y - self.nodes[:, 1])
        shortest, node = (distance + self.node_rest + detours).min(-1)
        found = shortest.isfinite()
        nearest_station = distance[..., : len(self.layout.stations)].argmin(-1)
        node = torch.where(found, node, nearest_station)
        sides = outside & self.node_clear[node] & found[..., None, None]
        return StationWay(
            self.nodes[node],
            self.node_rest[node],
            self.node_turning_radius[node],
            sides,
            distances,
            found,
        )

    def to_goal(self, position: Tensor, goal: Tensor) -> Tensor:
        """Return the next waypoint on the shortest way to a goal, ``(*batch, 2)``.

        This is the goal itself where it is in sight, or where no way exists.

        Args:
            position: The positions, ``(*batch, 2)``.
            goal: The goals, ``(*batch, 2)``.
        """
        if len(self.corners) == 0:
            return goal
        start, end = position.unsqueeze(-2), goal.unsqueeze(-2)
        # Corners must see the goal with something to spare: an agent near one then sees it too.
        spare = min(self.layout.start_margin, self.clearance) / 2
        corner_to_goal = self._sight(self.corners, end, spare)
        onwards = (self.corner_lengths + corner_to_goal.unsqueeze(-2)).amin(-1)
        by_corner = self._sight(start, self.corners, 0.0) + onwards
        length = torch.cat([self._sight(start, end, 0.0), by_corner], dim=-1)
        candidates = torch.cat(
            [end, self.corners.expand(*position.shape[:-1], *self.corners.shape)], dim=-2
        )
        best = length.argmin(-1)[..., None, None].expand(*position.shape[:-1], 1, 2)
        return candidates.gather(-2, best).squeeze(-2)

    def _sight(self, start: Tensor, end: Tensor, inflation: float) -> Tensor:
        distance = torch.linalg.vector_norm(end - start, dim=-1)
        return torch.where(visible(start, end, self.rectangles, inflation), distance, torch.inf)

    def _station_graph(self) -> list[tuple[str, Tensor]]:
        layout, clearance = self.layout, self.clearance
        rectangles = torch.tensor(layout.rectangles, dtype=torch.float64).reshape(-1, 4)
        stations = torch.tensor(layout.stations, dtype=torch.float64)
        limit = layout.wall - clearance
        wall = torch.tensor([-limit, limit], dtype=torch.float64)
        grid = torch.cartesian_prod(
            torch.cat([wall, rectangles[:, 0] - clearance, rectangles[:, 2] + clearance]).unique(),
            torch.cat([wall, rectangles[:, 1] - clearance, rectangles[:, 3] + clearance]).unique(),
        )
        free = (side_distances(grid, rectangles) >= clearance - _TOLERANCE).any(-1).all(-1)
        grid = grid[free & (grid.abs() <= limit + _TOLERANCE).all(-1)]

        nodes = torch.cat([stations, grid])
        is_station = torch.arange(len(nodes)) < len(stations)
        zero = torch.zeros(len(nodes), dtype=torch.float64)
        keep_off = torch.where(is_station, zero, clearance - _TOLERANCE)
        clear = side_distances(nodes, rectangles) > keep_off[:, None, None]
        edge = (clear.unsqueeze(0) & clear.unsqueeze(1)).any(-1).all(-1)
        turning_radius = torch.where(is_station, zero, clearance - MARGIN)
        turn = torch.where(is_station, zero, CAUTIOUS * layout.step_length + turning_radius)
        # Bellman-Ford from all stations at once, in as many rounds as the longest way has turns.
        lengths = torch.where(edge, _lengths(nodes), torch.inf)
        rest = torch.where(is_station, zero, torch.inf)
        while not torch.equal(
            shorter := torch.minimum(rest, (lengths + rest).amin(-1) + turn), rest
        ):
            rest = shorter
        # Sixteen rows for each rectangle: one for each combination of sides that it is seen from.
        side_codes = 2 ** torch.arange(4)
        seen_from = (torch.arange(16).unsqueeze(-1) & side_codes) > 0
        separable = (seen_from.unsqueeze(1) & clear.movedim(0, 1).unsqueeze(1)).any(-1)
        detours = torch.where(separable, zero, torch.inf).flatten(0, 1)
        return [
            ("rectangles", rectangles),
            ("node_detours", detours),
            ("side_codes", side_codes),
            ("first_rows", 16 * torch.arange(len(rectangles))),
            ("nodes", nodes),
            ("node_rest", rest),
            ("node_turning_radius", turning_radius),
            ("node_clear", clear),
        ]

    def _goal_graph(self) -> list[tuple[str, Tensor]]:
        layout, clearance = self.layout, self.clearance
        rectangles = torch.tensor(layout.rectangles, dtype=torch.float64).reshape(-1, 4)
        grown = rectangles + clearance * torch.tensor([-1, -1, 1, 1], dtype=torch.float64)
        corners = grown[:, [0, 1, 0, 3, 2, 1, 2, 3]].reshape(-1, 2)
        free = (side_distances(corners, rectangles) >= clearance - _TOLERANCE).any(-1).all(-1)
        corners = corners[free & (corners.abs() < layout.wall).all(-1)]
        # With this inflation an agent near a corner sees what the corner sees; without the small
        # charge per turn it would stop at the corner instead of going on.
        inflation, turn = 0.5 * clearance, 0.5 * clearance
        edge = visible(corners.unsqueeze(-2), corners, rectangles, inflation)
        lengths = torch.where(edge, _lengths(corners) + turn, torch.inf).fill_diagonal_(0)
        for middle in range(len(corners)):
            through = lengths[:, middle, None] + lengths[middle, None, :]
            lengths = torch.minimum(lengths, through)
        return [("corners", corners), ("corner_lengths", lengths + turn)]


def _lengths(points: Tensor) -> Tensor:
    return torch.linalg.vector_norm(points.unsqueeze(0) - points.unsqueeze(1), dim=-1)


def side_distances(position: Tensor, rectangles: Tensor) -> Tensor:
    """Return the signed distances to the prolonged sides of each rectangle, positive outside.

    Args:
        position: The positions, ``(*batch, 2)``.
        rectangles: The rectangles ``(x_low, y_low, x_high, y_high)``, ``(R, 4)``.

    Returns:
        ``(*batch, R, 4)``, in the order of the rectangle's columns.
    """
    point = position.unsqueeze(-2)
    return torch.cat([rectangles[:, :2] - point, point - rectangles[:, 2:]], dim=-1)


def visible(start: Tensor, end: Tensor, rectangles: Tensor, inflation: float) -> Tensor:
    """Tell whether straight segments cross no open rectangle grown by the inflation.

    The segment is cut by the two slabs of each rectangle; what is left of it lies inside.

    Args:
        start: The segments' one end, ``(*batch, 2)``, broadcast against `end`.
        end: The segments' other end, ``(*batch, 2)``.
        rectangles: The rectangles, ``(R, 4)``.
        inflation: The margin that rectangles are grown by, in arena units.

    Returns:
        bool, ``(*batch,)``.
    """
    start, step = start.unsqueeze(-2), (end - start).unsqueeze(-2)
    low, high = rectangles[:, :2] - inflation, rectangles[:, 2:] + inflation
    still = step == 0
    to_low = (low - start) / torch.where(still, 1.0, step)
    to_high = (high - start) / torch.where(still, 1.0, step)
    within = (start > low) & (start < high)
    enter = torch.where(
        still, torch.where(within, -torch.inf, torch.inf), torch.minimum(to_low, to_high)
    ).amax(-1)
    leave = torch.where(
        still, torch.where(within, torch.inf, -torch.inf), torch.maximum(to_low, to_high)
    ).amin(-1)
    blocked = (enter < leave) & (leave > 0) & (enter < 1)
    return ~blocked.any(-1)
