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

from cnfp_torchrl.tasks.point_nav.layout import Layout

CAUTIOUS = 0.9
"""The share of a step's length, and of a zone's radius, that plans count on."""

MARGIN = 1e-4
"""The distance from walls and rectangles that allowed actions keep, in arena units."""

_TOLERANCE = 1e-9


class StationWay(NamedTuple):
    """The way from a position to the station that is nearest along it.

    Batches come last in all fields, flattened: over first dimensions reductions are fastest.
    """

    corner: Tensor
    """The next point to go to straight, ``(2, B)``: a node of the grid or the station."""
    beyond: Tensor
    """What remains beyond the waypoint, its turn included, 0 at a station; and the distance from
    the waypoint within which all is visible that is visible from it, 0 at a station; ``(2, B)``."""
    side_distances: Tensor
    """The distances to the prolonged sides (x_low, y_low, x_high, y_high) of each rectangle,
    positive outside, ``(R, 4, B)``."""
    wall_distances: Tensor
    """The same of all beyond the walls, positive inside, ``(1, 4, B)``."""
    separating: Tensor
    """The distances to sides that the waypoint lies beyond, -inf for others and where no way was
    found, ``(R, 4, B)``: positive where a side separates its rectangle from both the position and
    the waypoint."""
    lost: Tensor
    """True inside rectangles and where no separable way exists, bool ``(B,)``; the waypoint is then
    the station nearest in a straight line."""
    batch: torch.Size
    """The batch size of the positions."""

    @property
    def waypoint(self) -> Tensor:
        """The next point to go to straight, ``(*batch, 2)``."""
        return self.corner.mT.reshape(*self.batch, 2)

    @property
    def rest(self) -> Tensor:
        """What remains beyond the waypoint, ``(*batch,)``."""
        return self.beyond[0].view(self.batch)

    @property
    def found(self) -> Tensor:
        """Whether a separable way exists, bool ``(*batch,)``."""
        return ~self.lost.view(self.batch)


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
    sides: Tensor
    outwards: Tensor
    side_codes: Tensor
    precedence: Tensor
    first_rows: Tensor
    node_x: Tensor
    node_y: Tensor
    numbers: Tensor
    node_lengths: Tensor
    node_table: Tensor
    far: Tensor
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
        at = position.reshape(-1, 2).mT.contiguous()
        distances = (self.sides + self.outwards * at).flatten(1, 2)
        node, lost = self._nearest_node(at, distances)
        count = len(self.rectangles)
        corner, beyond, clear = self.node_table.index_select(1, node).split((2, 2, 4 * count))
        side_distances, wall_distances = distances.split((count, 1))
        separating = side_distances + clear.view_as(side_distances)
        separating = separating.masked_fill(lost, -torch.inf)
        return StationWay(
            corner, beyond, side_distances, wall_distances, separating, lost, position.shape[:-1]
        )

    @torch.no_grad()
    def _nearest_node(self, at: Tensor, distances: Tensor) -> tuple[Tensor, Tensor]:
        """Return the numbers of the nodes to go to, and where none is seen, both ``(B,)``."""
        # The sides that a rectangle is seen from tell which nodes are separable from it: looked up,
        # not compared side by side with each node.
        seen_from = (distances[: len(self.first_rows)] > 0) * self.side_codes
        rows = seen_from.sum(1, dtype=torch.int32)
        if len(rows) == 1:
            lengths = self.node_lengths.index_select(1, rows[0])
        else:
            rows = rows + self.first_rows
            lengths = self.node_lengths.index_select(1, rows.flatten())
            lengths = lengths.unflatten(1, rows.shape).amax(1)
        # In place, as most of the time of large batches is that of memory. Not `torch.hypot`, which
        # takes as long as all of this.
        x, y = at.unbind()
        along = y - self.node_y
        distance = (x - self.node_x).square_().addcmul_(along, along).sqrt_()
        lengths = lengths.add_(distance)
        shortest = lengths.amin(0)
        # Not `min` with its index, nor `argmin`, which take some times as long: the least number of
        # nodes that are no farther, as any difference between two lengths exceeds 1e-20.
        node = lengths.sub_(shortest).mul_(1e30).add_(self.numbers).amin(0)
        # 0 for positions that are not finite.
        return node.nan_to_num_(0, 0).int(), shortest >= self.far

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
        needed = is_station | _are_needed(nodes, rest, clear, rectangles, layout.wall)
        nodes, is_station, clear = nodes[needed], is_station[needed], clear[needed]
        rest, turning_radius, zero = rest[needed], turning_radius[needed], zero[needed]
        # The lengths from each node onwards, in sixteen columns for each rectangle: one for each
        # combination of sides that it is seen from. A station behind one is farther than anything
        # else, so that the nearest of them is gone to if all are hidden. The arena hides nothing.
        far = 10 * (layout.wall + rest[rest.isfinite()].amax())
        side_codes = 2 ** torch.arange(4)
        seen_from = (torch.arange(16).unsqueeze(-1) & side_codes) > 0
        separable = (seen_from.unsqueeze(1) & clear.movedim(0, 1).unsqueeze(1)).any(-1)
        hidden = torch.where(separable, zero, torch.where(is_station, far, torch.inf))
        lengths = hidden.flatten(0, 1) + rest if len(rectangles) else rest.expand(16, -1)
        beyond_walls = torch.full((1, 4), layout.wall, dtype=torch.float64)
        sides = torch.cat([rectangles * torch.tensor([1, 1, -1, -1]), beyond_walls])
        clear = torch.where(clear, 0.0, -torch.inf).double().flatten(1)
        known = torch.cat([nodes, torch.stack([rest, turning_radius], -1), clear], 1)
        return [
            ("rectangles", rectangles),
            ("sides", sides.view(-1, 2, 2, 1)),
            ("outwards", torch.tensor([-1.0, 1.0])[:, None, None]),
            ("side_codes", side_codes.int().unsqueeze(-1)),
            # By which one of sides that are equally far is preferred.
            ("precedence", 1e-6 * layout.wall * torch.arange(4.0).unsqueeze(-1)),
            ("first_rows", 16 * torch.arange(max(len(rectangles), 1)).unsqueeze(-1)),
            ("node_x", nodes[:, :1]),
            ("node_y", nodes[:, 1:]),
            ("numbers", torch.arange(float(len(nodes))).unsqueeze(-1)),
            ("node_lengths", lengths.mT.contiguous()),
            ("node_table", known.mT.contiguous()),
            ("far", far),
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


def _are_needed(
    nodes: Tensor, rest: Tensor, clear: Tensor, rectangles: Tensor, wall: float
) -> Tensor:
    """Tell which nodes may be the best from anywhere in the arena, bool ``(N,)``.

    Prolonged sides of rectangles cut the arena into cells, in which all positions see the same
    nodes. A node is the best nowhere in a cell that sees another one with a shorter way onwards: by
    more than the distance of the two, or than what the cell's farthest corner from that one is
    farther away than the cell is from this one.

    Args:
        nodes: The nodes, ``(N, 2)``.
        rest: The lengths from them to the nearest station, ``(N,)``.
        clear: Which sides of each rectangle they are clear of, bool ``(N, R, 4)``.
        rectangles: The rectangles, ``(R, 4)``.
        wall: The largest coordinate in the arena.
    """
    spans = []
    for ends in (rectangles[:, 0::2], rectangles[:, 1::2]):
        lines = torch.cat([ends.flatten(), ends.new_tensor([-wall, wall])])
        lines = lines.clamp(-wall, wall).unique()
        # On the lines themselves fewer nodes may be seen than on either side.
        between = torch.stack([lines[:-1], lines[1:]], -1)
        spans.append(torch.cat([between, torch.stack([lines, lines], -1)]))
    index = torch.cartesian_prod(*(torch.arange(len(span)) for span in spans)).unbind(-1)
    low, high = torch.stack([span[i] for span, i in zip(spans, index, strict=True)], 1).unbind(-1)
    beyond = side_distances((low + high) / 2, rectangles) > 0
    seen = (beyond.unsqueeze(1) & clear).any(-1).all(-1)
    offsets = torch.stack([low.unsqueeze(1) - nodes, nodes - high.unsqueeze(1)])
    nearest = torch.linalg.vector_norm(offsets.amax(0).clamp(min=0), dim=-1)
    farthest = torch.linalg.vector_norm(offsets.amin(0), dim=-1)
    needed = rest.isfinite()
    for n, apart in enumerate(_lengths(nodes)):
        beats = torch.minimum(apart, farthest - nearest[:, n : n + 1]) + rest < rest[n]
        needed[n] &= (seen[:, n] & ~(beats & seen).any(-1)).any()
    return needed


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
