"""The legend of the stage views and the map, in their own colors."""

from __future__ import annotations

import rerun as rr

from cnfp_torchrl.visual.colors import rgb
from cnfp_torchrl.visual.stream import style
from cnfp_torchrl.visual.stream.entities import Entities
from cnfp_torchrl.visual.stream.scene import LEGEND, FlowScene

_COLUMNS = 3
COLUMN_WIDTH, ROW_HEIGHT = 3.3, 0.62


def legend_size(scene: FlowScene) -> tuple[float, float]:
    """Return width and height of the legend."""
    rows = -(-len(_entries(scene)) // _COLUMNS)
    return COLUMN_WIDTH * _COLUMNS, ROW_HEIGHT * rows


def log_legend(stream: rr.RecordingStream, scene: FlowScene) -> None:
    """Log the legend, once for all steps."""
    entries = _entries(scene)
    places = [
        (COLUMN_WIDTH * (0.5 + i % _COLUMNS), ROW_HEIGHT * (0.35 + i // _COLUMNS))
        for i in range(len(entries))
    ]
    points = rr.Points2D(
        places,
        labels=list(entries),
        colors=list(entries.values()),
        radii=style.MARK_INSIDE,
        show_labels=True,
    )
    Entities(stream, LEGEND).style("", points)


def _entries(scene: FlowScene) -> dict[str, style.Color]:
    entries = {f"{name} set": rgb(color) for name, color in scene.colors.items()}
    return {
        "executed action, its path": style.EXECUTED,
        "samples of the policy": style.SAMPLE,
        "allowed so far": style.PALE,
        **entries,
        "density": style.GLOW,
        "samples outside": style.BREAKS,
        **({"goal": style.GOAL_COLOR, "station": style.STATION_COLOR} if scene.layout else {}),
    }
