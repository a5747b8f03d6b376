"""Figures without pyplot: made, styled and saved without any global state of a window system."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.typing import RcKeyType

from cnfp_torchrl.visual.colors import FAINT, INK, MUTED
from cnfp_torchrl.whole_file import whole_file

_STYLE: dict[RcKeyType, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.8,
    "axes.titlesize": 9.5,
    "axes.labelsize": 8.5,
    "figure.facecolor": "white",
    "figure.titlesize": 11.5,
    "grid.color": FAINT,
    "grid.linewidth": 0.6,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "savefig.facecolor": "white",
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
}


@contextmanager
def house_style() -> Iterator[None]:
    """Draw inside this context in the style of this package, whatever the user's settings."""
    with matplotlib.rc_context():
        # Not from the user's settings: a figure of a run looks the same on every machine.
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        yield


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches, laid out so that nothing overlaps."""
    return Figure(figsize=(width, height), layout="constrained")


def save_png(figure: Figure, path: Path, *, dpi: int = 130) -> Path:
    """Write a figure as PNG and return where it is."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with house_style(), whole_file(path) as file:
        figure.savefig(file, dpi=dpi, format="png")
    return path


def message_figure(title: str, message: str) -> Figure:
    """Return a figure that says why there is nothing to draw."""
    with house_style():
        figure = new_figure(7.0, 2.2)
        figure.suptitle(title)
        axes = figure.add_subplot()
        axes.set_axis_off()
        axes.text(0.5, 0.5, message, ha="center", va="center", color=MUTED, wrap=True)
    return figure


def say(axes: Axes, message: str) -> None:
    """Write a remark into the middle of a panel that has nothing else to show."""
    axes.text(0.5, 0.5, message, transform=axes.transAxes, ha="center", va="center", color=MUTED)
