"""The dynamics of point navigation in batched torch, shared by its environments."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn

from cnfp_torchrl.tasks.point_nav.indicators import (
    battery_low,
    leaves_arena,
    segment_touches_rectangle,
)
from cnfp_torchrl.tasks.point_nav.layout import BATTERY_FULL, Layout

Collision = Literal["pass", "block"]
"""The effect of a collision: it is counted (``pass``), or also stops the agent (``block``)."""

CONSTRAINT_NAMES = ("obstacle", "battery")
"""The names of the columns of `Transition.cost`."""


class State(NamedTuple):
    """A state of the task: what the observation shows, with the battery in whole percent."""

    position: Tensor
    """float32, ``(*batch, 2)``."""
    battery: Tensor
    """int64 in 0..100, ``(*batch,)``; a float's rounding would at times cost a whole step."""
    goal: Tensor
    """float32, ``(*batch, 2)``."""

    def where(self, mask: Tensor, other: State) -> State:
        """Return this state where the mask ``(*batch,)`` is true and the other one elsewhere."""
        wide = mask.unsqueeze(-1)
        return State(
            torch.where(wide, self.position, other.position),
            torch.where(mask, self.battery, other.battery),
            torch.where(wide, self.goal, other.goal),
        )

    def observation(self) -> Tensor:
        """Return ``(x, y, n / 100, goal x, goal y)``, float32, ``(*batch, 5)``."""
        battery = (self.battery / BATTERY_FULL).to(self.position.dtype).unsqueeze(-1)
        return torch.cat([self.position, battery, self.goal], dim=-1)


class Transition(NamedTuple):
    """The outcome of one step."""

    state: State
    reward: Tensor
    """float32, ``(*batch,)``."""
    cost: Tensor
    """The indicators as 0 or 1, float32, ``(*batch, 2)``, columns as `CONSTRAINT_NAMES`."""


class PointNavDynamics(nn.Module):
    """Steps and starts of the constrained point navigation task (paper, section Experiments).

    It holds the map as tensors and no state: `step` and `sample` are functions of their arguments
    and of the generator. The map is rounded to float32 once, so that a position equal to
    an edge as a float32 number touches that edge.

    Args:
        layout: The map; None takes the reference task.
        collision: The effect of a collision, ``pass`` or ``block``.

    Raises:
        ValueError: for an unknown `collision`, and where rectangles leave no room for starts.
    """

    rectangles: Tensor
    stations: Tensor
    wall: Tensor
    zone_radius: Tensor
    goal_radius: Tensor
    cell_low: Tensor
    cell_size: Tensor
    cell_share: Tensor

    def __init__(self, layout: Layout | None = None, collision: Collision = "pass") -> None:
        super().__init__()
        if collision not in get_args(Collision):
            raise ValueError(
                f"collision: expected one of {list(get_args(Collision))}, given {collision!r}"
            )
        self.layout = Layout() if layout is None else layout
        self.collision = collision
        cell_low, cell_size, cell_share = _start_cells(self.layout)
        for name, value in {
            "rectangles": _float32(self.layout.rectangles).reshape(-1, 4),
            "stations": _float32(self.layout.stations),
            "wall": _float32(self.layout.wall),
            "zone_radius": _float32(self.layout.zone_radius),
            "goal_radius": _float32(self.layout.goal_radius),
            "cell_low": cell_low,
            "cell_size": cell_size,
            "cell_share": cell_share,
        }.items():
            self.register_buffer(name, value, persistent=False)

    def step(self, state: State, action: Tensor, generator: torch.Generator) -> Transition:
        """Move by the action, ``(*batch, 2)``, clipped to [-1, 1]; reward, indicators, new goal.

        The order is part of the task: the battery loses a percent, then the battery indicator is
        read, then a station at the new position charges.
        """
        layout = self.layout
        target = state.position + layout.step_length * action.to(state.position).clamp(-1, 1)
        collides = segment_touches_rectangle(state.position, target, self.rectangles)
        collides = collides | leaves_arena(target, self.wall)
        if self.collision == "block":
            target = torch.where(collides.unsqueeze(-1), state.position, target)
        position = torch.clamp(target, -self.wall, self.wall)

        battery = (state.battery - 1).clamp(min=0)
        cost = torch.stack([collides, battery_low(battery, layout.battery_threshold)], dim=-1)
        to_stations = _distance(position.unsqueeze(-2), self.stations)
        charges = (to_stations <= self.zone_radius.double()).any(-1)
        battery = torch.where(charges, BATTERY_FULL, battery)

        to_goal = _distance(position, state.goal)
        reached = to_goal <= self.goal_radius.double()
        reward = reached * layout.goal_bonus - to_goal
        fresh = self.sample_positions(state.battery.shape, generator)
        goal = torch.where(reached.unsqueeze(-1), fresh, state.goal)
        return Transition(State(position, battery, goal), reward.float(), cost.float())

    def sample(
        self,
        batch: torch.Size,
        generator: torch.Generator,
        *,
        position: Any = None,
        battery: Any = None,
        goal: Any = None,
    ) -> State:
        """Draw starting states; parts that are given replace the drawn ones.

        Args:
            batch: The batch shape.
            generator: The source of random numbers, advanced by the same amount in any case.
            position: The positions, anywhere in the arena, broadcast to ``(*batch, 2)``.
            battery: The charges in whole percent, broadcast to ``(*batch,)``.
            goal: The goals, anywhere in the arena, broadcast to ``(*batch, 2)``.

        Raises:
            ValueError: for a given value of the wrong kind, range or shape.
        """
        low, high = self.layout.battery_start
        wall, device = self.layout.wall, self.cell_low.device
        charge = torch.randint(low, high + 1, batch, generator=generator, device=device)
        return State(
            _take("position", position, self.sample_positions(batch, generator), -wall, wall),
            _take("battery", battery, charge, 0, BATTERY_FULL),
            _take("goal", goal, self.sample_positions(batch, generator), -wall, wall),
        )

    def sample_positions(self, batch: torch.Size, generator: torch.Generator) -> Tensor:
        """Draw positions uniformly from the start region, float32, ``(*batch, 2)``.

        The region is cut into cells; a cell is drawn by its share of the area, then a point in it.
        Rejection sampling would draw a varying number of random numbers, in a loop.
        """
        draw = torch.rand(
            (*batch, 3), generator=generator, device=self.cell_low.device, dtype=torch.float64
        )
        cell = torch.searchsorted(self.cell_share, draw[..., 0].contiguous(), right=True)
        return (self.cell_low[cell] + draw[..., 1:] * self.cell_size[cell]).float()


def _take(name: str, given: Any, drawn: Tensor, low: float, high: float) -> Tensor:
    """Return the given value as a tensor like the drawn one, or the drawn one for None."""
    if given is None:
        return drawn
    value = torch.as_tensor(given, device=drawn.device)
    kind_fits = drawn.is_floating_point() or not value.is_floating_point()
    if not kind_fits or not bool(((value >= low) & (value <= high)).all()):
        kind = "numbers" if drawn.is_floating_point() else "integers"
        raise ValueError(f"{name}: expected {kind} in [{low}, {high}], given {given}")
    try:
        return value.to(drawn.dtype).expand(drawn.shape).clone()
    except RuntimeError:
        raise ValueError(
            f"{name}: expected a shape that broadcasts to {tuple(drawn.shape)}, "
            f"given {tuple(value.shape)}"
        ) from None


def _float32(values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float32)


def _distance(a: Tensor, b: Tensor) -> Tensor:
    """Return the Euclidean distance in float64, in which zones and goals are compared."""
    return torch.linalg.vector_norm(a.double() - b.double(), dim=-1)


def _start_cells(layout: Layout) -> tuple[Tensor, Tensor, Tensor]:
    """Cut the start region along the edges of the grown rectangles.

    Returns:
        lower corners ``(C, 2)``, sizes ``(C, 2)`` and the upper ends of the cumulative shares of
        the area but for the last, which is 1, ``(C - 1,)``; float64.
    """
    limit, margin = layout.start_limit, layout.start_margin
    grown = torch.tensor(layout.rectangles, dtype=torch.float64).reshape(-1, 4)
    grown = grown + torch.tensor([-margin, -margin, margin, margin], dtype=torch.float64)
    ends = torch.tensor([-limit, limit], dtype=torch.float64)
    x = torch.cat([grown[:, [0, 2]].reshape(-1), ends]).clamp(-limit, limit).unique()
    y = torch.cat([grown[:, [1, 3]].reshape(-1), ends]).clamp(-limit, limit).unique()
    low, high = torch.cartesian_prod(x[:-1], y[:-1]), torch.cartesian_prod(x[1:], y[1:])
    middle = ((low + high) / 2).unsqueeze(1)
    covered = ((middle > grown[:, :2]) & (middle < grown[:, 2:])).all(-1).any(-1)
    low, size = low[~covered], (high - low)[~covered]
    if len(low) == 0:
        raise ValueError(
            f"Layout.rectangles: expected room for starts and goals in [-{limit}, {limit}]^2, "
            f"given {layout.rectangles}, which cover it when grown by start_margin = {margin}"
        )
    share = size.prod(-1).cumsum(0)
    return low, size, (share / share[-1])[:-1]
