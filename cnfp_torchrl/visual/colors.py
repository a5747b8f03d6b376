"""One color for each constraint, in every figure and stream."""

from __future__ import annotations

import colorsys
from collections.abc import Iterable

# The palette of Okabe and Ito, which stays distinguishable with any color vision.
INK = "#222222"
MUTED = "#8A8A8A"
FAINT = "#D9D9D9"
GOAL = "#E69F00"

_CONSTRAINTS = (
    "#0072B2", "#D55E00", "#CC79A7", "#009E73", "#56B4E9", "#E69F00", "#6A3D9A", "#8C510A",
)  # fmt: skip


def constraint_colors(names: Iterable[str]) -> dict[str, str]:
    """Return a color, as ``#RRGGBB``, for each constraint.

    It depends on the set of names alone, not on their order: a run with another flow order shows
    the same colors. From nine names on, colors repeat.

    Args:
        names: The names of all constraints, in any order.
    """
    given = list(dict.fromkeys(names))
    numbered = {name: _CONSTRAINTS[i % len(_CONSTRAINTS)] for i, name in enumerate(sorted(given))}
    return {name: numbered[name] for name in given}


def curve_colors(count: int) -> list[tuple[int, int, int]]:
    """Return as many colors, as far from each other as the color wheel allows, for curves."""
    wheel = (colorsys.hsv_to_rgb(i / max(count, 1), 0.6, 0.95) for i in range(count))
    return [(round(255 * r), round(255 * g), round(255 * b)) for r, g, b in wheel]


def rgb(color: str) -> tuple[int, int, int]:
    """Return the red, green and blue of ``#RRGGBB``, each in 0..255."""
    red, green, blue = bytes.fromhex(color.removeprefix("#"))
    return red, green, blue
