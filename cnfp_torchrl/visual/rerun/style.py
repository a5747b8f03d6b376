"""Entity paths, and colors and sizes on a dark background; constraints keep those of figures.

Of entities that more than one view has, also in which order they are drawn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import rerun as rr

from cnfp_torchrl.visual.colors import GOAL, rgb
from cnfp_torchrl.visual.setting import Setting, StageView

TIMELINE = "env_step"
PICTURE = "picture"
MAP = "map"
LEGEND = "legend"
EXPLANATION = "explanation"
SERIES = "series"
METRICS = "metrics"

Color = tuple[int, int, int]

BACKGROUND: Color = (0, 0, 4)
PALE: Color = (235, 235, 240)
MUTED: Color = (120, 122, 135)
FAINT: Color = (62, 64, 76)
WAY: Color = (84, 70, 120)
SAMPLE: Color = (190, 196, 214)
BREAKS: Color = (255, 226, 30)
EXECUTED: Color = (80, 255, 190)
TRAIL: Color = (150, 154, 170)
REWARD: Color = (240, 190, 80)
GLOW: Color = (160, 47, 127)
CURVE: Color = (160, 120, 230)
GOAL_ZONE: Color = (78, 56, 12)
GOAL_COLOR: Color = rgb(GOAL)

HEAT: Literal["magma"] = "magma"
HEAT_TOP = 420
"""Bytes up to 255 are drawn with the lower part of the colors, which lines stand out from."""

# Radii on the screen, which Rerun tells from those in the scene by their sign.
THIN = -0.8
LINE = -1.3
WIDE = -2.2
BAR = -3.0
DOT = -1.3
BAD_DOT = -2.0
KNOT = -3.0
MARK = -5.5
MARK_INSIDE = -3.5


def episode_timeline(number: int) -> str:
    """Return the timeline of an episode, on which its steps are counted from 0."""
    return f"episode_{number}"


def series_path(plot: str, curve: str | None = None) -> str:
    """Return the path of a plot's entity, or of that of one of its curves."""
    parts = [SERIES, *plot.split("/"), *([] if curve is None else [curve])]
    return rr.new_entity_path(parts).strip("/")


def stage_path(setting: Setting, view: StageView) -> str:
    """Return the path under which the entities of a stage's view lie."""
    parts = ["stages", f"{view.stage + 1} {setting.stages[view.stage]}"]
    if setting.dim > 2:
        parts.append(setting.names(view.components))
    return rr.new_entity_path(parts).strip("/")


def dimmed(color: Color) -> Color:
    """Return a color half way to the background, for what does not hold."""
    red, green, blue = ((c + b) // 2 for c, b in zip(color, BACKGROUND, strict=True))
    return red, green, blue


def stage_styles(stage: int) -> Mapping[str, Sequence[rr.AsComponents]]:
    """Return the styles of what the view of a stage shows in the plane and on the line, by entity.

    Args:
        stage: The stage's index, which says how many points the executed action's path has before
            it.
    """
    lines, points = rr.LineStrips2D.from_fields, rr.Points2D.from_fields
    return {
        "bounds": [lines(colors=FAINT, radii=THIN, draw_order=0)],
        "samples": [points(colors=SAMPLE, radii=DOT, draw_order=10)],
        "samples_outside": [points(colors=BREAKS, radii=BAD_DOT, draw_order=11)],
        "set_so_far": [lines(colors=PALE, radii=THIN, draw_order=21)],
        "executed": [
            lines(colors=EXECUTED, radii=LINE, draw_order=30),
            points(
                colors=[EXECUTED] * stage + [BACKGROUND, EXECUTED],
                radii=[KNOT] * stage + [MARK, MARK_INSIDE],
                draw_order=31,
            ),
        ],
    }
