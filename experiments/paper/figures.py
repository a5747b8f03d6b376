"""All figures of the report, by name, with what readers have to know of each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from cnfp_torchrl.visual.figures.canvas import save_png
from experiments.paper.figures_comparison import draw_afterwards, draw_summary, draw_trade_off
from experiments.paper.figures_flow import KeptPolicy, flow_figures
from experiments.paper.figures_hostile import draw_hostile
from experiments.paper.figures_mappings import draw_mappings
from experiments.paper.figures_training import draw_training, draw_violation_rates
from experiments.paper.hostile import HostileRun
from experiments.paper.records import Record

FIGURES = {
    "trade_off": (
        "Score against violations for all methods",
        "Each dot is a run, each mark a method's interquartile mean with its intervals. The axis "
        "of violations is logarithmic from 1 on and linear below, so that 0 stands on it.",
    ),
    "training": (
        "Return and cumulative violations over training",
        "The paper's fourth figure: interquartile means over seeds, bands their 95 % intervals. "
        "Methods that coincide at 0 are told by their markers.",
    ),
    "violations_per_episode": (
        "Violating steps per episode over training",
        "Each round of episodes, which all agents end together. Axes are linear below 0.1.",
    ),
    "summary": (
        "Scores, areas, speed and violations with intervals",
        "Marks are interquartile means, bars their 95 % bootstrap intervals, faint dots the runs. "
        "A method of which some run never reached the score has no mean there.",
    ),
    "afterwards": (
        "Return and violations after a change of the constraints",
        "Trained policies, stochastic, in the task as it was and in two changed ones, without "
        "another step of training.",
    ),
    "hostile": (
        "Violations of hostile networks behind each flow",
        "Untrained networks and networks made to break constraints, with means up to a million; "
        "the details are in `experiments/results/hostile_networks.md`.",
    ),
    "flow": (
        "The flow on the map",
        "The paper's first figure. The Gaussian: {source}. The last caption counts among "
        "a million fresh samples.",
    ),
    "permissive": (
        "The flow in a permissive state",
        "The paper's third figure, top: nothing near, battery full. The Gaussian: {source}.",
    ),
    "restrictive": (
        "The flow in a restrictive state",
        "The paper's third figure, bottom: at a wall, with two steps of battery left. The "
        "Gaussian: {source}.",
    ),
    "mappings": (
        "Particles before and after each mapping",
        "The paper's second figure: its squashes in the first row, then a retraction and the exact "
        "flow into further sets, within the dashed action bounds; a shell has a squash of its own. "
        "A particle keeps its color.",
    ),
}
"""Title and caption by the name of the file."""


def draw_figures(
    records: Sequence[Record],
    hostile: Sequence[HostileRun],
    policy: KeptPolicy,
    folder: Path,
    *,
    dpi: int = 96,
) -> list[Path]:
    """Draw every figure for which there is data, and return the files.

    Args:
        records: one or more.
        hostile: of hostile networks; none leaves their figure out.
        policy: whose flow is drawn.
        folder: where to; made if need be, files of the same names are replaced.
        dpi: dots per inch.
    """
    figures: dict[str, Figure] = {
        "trade_off": draw_trade_off(records),
        "training": draw_training(records),
        "violations_per_episode": draw_violation_rates(records),
        "summary": draw_summary(records),
        "afterwards": draw_afterwards(records),
        **flow_figures(policy),
        "mappings": draw_mappings(),
    }
    if hostile:
        figures["hostile"] = draw_hostile(hostile)
    return [save_png(figure, folder / f"{name}.png", dpi=dpi) for name, figure in figures.items()]
