"""Pictures of point navigation, drawn with Pillow, without a window or a plotting library."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnfp_torchrl.tasks.point_nav.layout import BATTERY_FULL, Layout

if TYPE_CHECKING:
    from PIL import Image

# Pillow is imported where it draws: the environment without pictures does not need it.

# The palette of Okabe and Ito, which stays distinguishable with any color vision.
BLUE, ORANGE, GREEN, VERMILION = "#0072B2", "#E69F00", "#009E73", "#D55E00"
INK, OBSTACLE, FLOOR, ZONE, TRACK = "#222222", "#5A5A5A", "#FFFFFF", "#CDEBE1", "#E6E6E6"

_SUPERSAMPLING = 3
_SIZE = 512

Point = tuple[float, float]


def render_point_nav(
    layout: Layout,
    *,
    position: Point,
    battery: int,
    goal: Point,
    trail: Sequence[Point] = (),
    size: int = _SIZE,
) -> NDArray[np.uint8]:
    """Draw the map, goal, agent with its trail, and the battery with its threshold.

    Args:
        layout: The map.
        position: The agent's position, in arena units.
        battery: The charge in whole percent.
        goal: The goal's position, in arena units.
        trail: The positions so far, oldest first; the line fades towards the oldest.
        size: The width of the square picture, in pixels.

    Returns:
        uint8, ``(size, size, 3)``.
    """
    from PIL import Image

    canvas = _Canvas(layout, size, _background(layout, size).copy())
    canvas.disc(goal, layout.goal_radius, fill="#FBE7BF", outline=ORANGE)
    canvas.disc(goal, 0.3 * layout.goal_radius, fill=ORANGE)
    canvas.walls()
    canvas.trail(trail)
    canvas.disc(position, 0.033 * layout.wall, fill=BLUE, outline=FLOOR)
    canvas.battery(battery, layout.battery_threshold)
    return np.asarray(canvas.image.resize((size, size), Image.Resampling.LANCZOS))


@lru_cache(maxsize=8)
def _background(layout: Layout, size: int) -> Image.Image:
    from PIL import Image

    side = size * _SUPERSAMPLING
    canvas = _Canvas(layout, size, Image.new("RGB", (side, side), FLOOR))
    for station in layout.stations:
        canvas.disc(station, layout.zone_radius, fill=ZONE, outline=GREEN)
    for station in layout.stations:
        canvas.square(station, 0.02 * layout.wall, fill=GREEN)
    for x_low, y_low, x_high, y_high in layout.rectangles:
        canvas.rectangle((x_low, y_low), (x_high, y_high), fill=OBSTACLE)
    canvas.walls()
    return canvas.image


class _Canvas:
    """Draw in arena units on an oversized picture; the map above, the battery bar below."""

    def __init__(self, layout: Layout, size: int, image: Image.Image) -> None:
        from PIL import ImageDraw

        self.image = image
        self.wall = layout.wall
        self.unit = size * _SUPERSAMPLING / _SIZE
        self.map_low = (40 * self.unit, 16 * self.unit)
        self.map_side = 432 * self.unit
        self._draw = ImageDraw.Draw(image)

    def pixel(self, point: Point) -> Point:
        scale = self.map_side / (2 * self.wall)
        x_low, y_low = self.map_low
        return x_low + (point[0] + self.wall) * scale, y_low + (self.wall - point[1]) * scale

    def disc(self, center: Point, radius: float, fill: str, outline: str | None = None) -> None:
        low = self.pixel((center[0] - radius, center[1] + radius))
        high = self.pixel((center[0] + radius, center[1] - radius))
        self._draw.ellipse((low, high), fill, outline, round(1.5 * self.unit))

    def square(self, center: Point, half: float, fill: str) -> None:
        low, high = (center[0] - half, center[1] - half), (center[0] + half, center[1] + half)
        self.rectangle(low, high, fill)

    def rectangle(self, low: Point, high: Point, fill: str) -> None:
        self._draw.rectangle((self.pixel((low[0], high[1])), self.pixel((high[0], low[1]))), fill)

    def walls(self) -> None:
        width = round(4 * self.unit)
        low = tuple(x - width for x in self.map_low)
        high = tuple(x + self.map_side + width for x in self.map_low)
        # Covers the parts of zones beyond the walls.
        side = self.image.width
        for strip in (
            (0, 0, side, low[1]),
            (0, high[1], side, side),
            (0, 0, low[0], side),
            (high[0], 0, side, side),
        ):
            self._draw.rectangle(strip, FLOOR)
        self._draw.rectangle((low, high), None, INK, width)

    def trail(self, points: Sequence[Point]) -> None:
        for i in range(1, len(points)):
            shade = _mix(BLUE, FLOOR, 0.25 + 0.75 * i / len(points))
            ends = (self.pixel(points[i - 1]), self.pixel(points[i]))
            self._draw.line(ends, shade, round(2 * self.unit))

    def battery(self, percent: int, threshold: int) -> None:
        from PIL import ImageFont

        u = self.unit
        left, right, top, bottom = 100 * u, 412 * u, 470 * u, 488 * u
        scale = (right - left) / BATTERY_FULL
        color = BLUE if percent >= threshold else VERMILION
        self._draw.rectangle((left, top, right, bottom), TRACK)
        if percent > 0:
            self._draw.rectangle((left, top, left + percent * scale, bottom), color)
        mark = left + threshold * scale
        self._draw.line((mark, top - 5 * u, mark, bottom + 5 * u), VERMILION, round(2.5 * u))
        font = ImageFont.load_default(round(14 * u))
        middle = (top + bottom) / 2
        self._draw.text((left - 8 * u, middle), "battery", INK, font, "rm")
        self._draw.text((right + 8 * u, middle), f"{percent} %", INK, font, "lm")


def _mix(color: str, other: str, share: float) -> tuple[int, int, int]:
    """Return ``share`` of the first color and the rest of the second one."""
    first, second = (tuple(bytes.fromhex(text[1:])) for text in (color, other))
    r, g, b = (round(share * a + (1 - share) * c) for a, c in zip(first, second, strict=True))
    return r, g, b
