"""The map of the point navigation task and its physical constants."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

BATTERY_FULL = 100
"""The battery's charge is a whole percentage, 0 to 100."""

EPISODE_STEPS = 100
"""Episodes of the reference task are truncated after this many steps; there is no other end."""


@dataclass(frozen=True)
class Layout:
    """A square arena with rectangular obstacles and charging stations.

    The defaults are the reference task: one rectangle in the middle, a station at each side.
    Positions and lengths are in arena units, the battery is in whole percent. Lists are accepted
    wherever a tuple is named, so that a configuration file can state a layout.

    Args:
        rectangles: The closed obstacles ``(x_low, y_low, x_high, y_high)``; there may be none.
        stations: The charging stations ``(x, y)``, at least one.
        wall: The coordinate of the walls, which stand at +-wall on both axes.
        zone_radius: The largest distance at which a station charges.
        step_length: The length by which an action a moves the agent, ``step_length * a``.
        goal_radius: The largest distance at which the goal is reached.
        goal_bonus: The reward for reaching the goal.
        start_limit: The half width of the square that starts and goals are drawn from uniformly.
        start_margin: The margin around every rectangle in which none is drawn.
        battery_threshold: The percentage below which the charge violates the battery constraint.
        battery_start: The lowest and highest charge at the start, both included.

    Raises:
        ValueError: naming the field, what was expected and what was given.
    """

    rectangles: tuple[tuple[float, float, float, float], ...] = ((-0.3, -0.3, 0.3, 0.3),)
    stations: tuple[tuple[float, float], ...] = (
        (-0.95, 0.0),
        (0.95, 0.0),
        (0.0, -0.95),
        (0.0, 0.95),
    )
    wall: float = 1.0
    zone_radius: float = 0.1
    step_length: float = 0.1
    goal_radius: float = 0.1
    goal_bonus: float = 10.0
    start_limit: float = 0.95
    start_margin: float = 0.01
    battery_threshold: int = 20
    battery_start: tuple[int, int] = (40, 100)

    def __post_init__(self) -> None:
        for field in ("wall", "zone_radius", "step_length", "goal_radius", "start_limit"):
            self._set(field, _number(field, getattr(self, field), minimum=0, exclusive=True))
        self._set("start_margin", _number("start_margin", self.start_margin, minimum=0))
        self._set("goal_bonus", _number("goal_bonus", self.goal_bonus))
        self._set("rectangles", _tuples("rectangles", self.rectangles, length=4))
        self._set("stations", _tuples("stations", self.stations, length=2))
        self._check_map()
        self._check_battery()

    def _set(self, field: str, value: object) -> None:
        object.__setattr__(self, field, value)

    def _check_map(self) -> None:
        if self.start_limit > self.wall:
            raise ValueError(
                f"Layout.start_limit: expected at most the wall at {self.wall}, "
                f"given {self.start_limit}; starts must lie inside the arena"
            )
        for i, (x_low, y_low, x_high, y_high) in enumerate(self.rectangles):
            if not (x_low < x_high and y_low < y_high):
                raise ValueError(
                    f"Layout.rectangles[{i}]: expected (x_low, y_low, x_high, y_high) with "
                    f"x_low < x_high and y_low < y_high, given {self.rectangles[i]}"
                )
            if max(abs(x_low), abs(y_low), abs(x_high), abs(y_high)) > self.wall:
                raise ValueError(
                    f"Layout.rectangles[{i}]: expected to lie within the walls at "
                    f"+-{self.wall}, given {self.rectangles[i]}"
                )
        if not self.stations:
            raise ValueError(
                "Layout.stations: expected at least one station (x, y), given none; "
                "without one no policy can keep the battery charged"
            )
        for i, (x, y) in enumerate(self.stations):
            if max(abs(x), abs(y)) >= self.wall:
                raise ValueError(
                    f"Layout.stations[{i}]: expected to lie within the walls at "
                    f"+-{self.wall}, given {self.stations[i]}"
                )
            for j, (x_low, y_low, x_high, y_high) in enumerate(self.rectangles):
                if x_low <= x <= x_high and y_low <= y <= y_high:
                    raise ValueError(
                        f"Layout.stations[{i}]: expected to lie outside all rectangles, "
                        f"given {self.stations[i]} in rectangles[{j}] {self.rectangles[j]}"
                    )

    def _check_battery(self) -> None:
        threshold = _whole("battery_threshold", self.battery_threshold)
        if not 0 <= threshold < BATTERY_FULL:
            raise ValueError(
                f"Layout.battery_threshold: expected a percentage in [0, {BATTERY_FULL}), "
                f"given {threshold}"
            )
        start = tuple(
            _whole("battery_start", n) for n in _sequence("battery_start", self.battery_start)
        )
        if len(start) != 2 or not threshold < start[0] <= start[1] <= BATTERY_FULL:
            raise ValueError(
                f"Layout.battery_start: expected (lowest, highest) with battery_threshold = "
                f"{threshold} < lowest <= highest <= {BATTERY_FULL}, given {start}"
            )
        self._set("battery_start", start)


def _number(
    field: str, value: Any, *, minimum: float = -math.inf, exclusive: bool = False
) -> float:
    good = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    if not good or value < minimum or (exclusive and value == minimum):
        bound = "" if minimum == -math.inf else f" {'>' if exclusive else '>='} {minimum}"
        raise ValueError(f"Layout.{field}: expected a finite number{bound}, given {value!r}")
    return float(value)


def _whole(field: str, value: Any) -> int:
    if not isinstance(value, Integral) or isinstance(value, bool):
        raise ValueError(f"Layout.{field}: expected whole percentages, given {value!r}")
    return int(value)


def _sequence(field: str, value: Any) -> Sequence[Any]:
    if not isinstance(value, Sequence) or isinstance(value, str):
        raise ValueError(f"Layout.{field}: expected a list or tuple, given {value!r}")
    return value


def _tuples(field: str, value: Any, *, length: int) -> tuple[tuple[float, ...], ...]:
    rows = []
    for i, row in enumerate(_sequence(field, value)):
        numbers = tuple(_number(f"{field}[{i}]", x) for x in _sequence(f"{field}[{i}]", row))
        if len(numbers) != length:
            raise ValueError(
                f"Layout.{field}[{i}]: expected {length} numbers, given {len(numbers)}: {numbers}"
            )
        rows.append(numbers)
    return tuple(rows)
