"""The figure of a sweep: the score of every run, and means over seeds with their intervals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from cnfp_torchrl.training.sweep import SEED, Mean, SweepRun, over_seeds, varied
from cnfp_torchrl.visual.colors import INK, MUTED
from cnfp_torchrl.visual.figures.canvas import house_style, message_figure, new_figure, save_png

_BROKEN = "tab:red"


def save_sweep(runs: Sequence[SweepRun], path: Path) -> Path:
    """Draw the scores of a sweep's runs, a row for each setting, and write them as PNG.

    Args:
        runs: The runs.
        path: The file.
    """
    groups = over_seeds(runs)
    if not any(run.is_done for run in runs):
        return save_png(message_figure("Sweep", "no run is done yet"), path)
    keys = [key for key in varied(runs) if key != SEED]
    with house_style():
        figure = new_figure(7.5, 1.3 + 0.28 * len(groups))
        axes = figure.add_subplot()
        for row, group in enumerate(groups.values()):
            done = [(run.score, run.violations) for run in group if run.score is not None]
            for score, violations in done:
                color = _BROKEN if violations else MUTED
                axes.plot(score, row, "o", color=color, alpha=0.6, markersize=4)
            scores = [score for score, _ in done]
            if len(scores) > 1:
                mean = Mean.of(scores)
                axes.errorbar(
                    mean.value,
                    row,
                    xerr=mean.half_width,
                    fmt="|",
                    color=INK,
                    capsize=3,
                    markersize=9,
                )
            if len(done) < len(group):
                missing = f"{len(group) - len(done)} of {len(group)} not done"
                axes.annotate(
                    missing, (1.0, row), xycoords=("axes fraction", "data"), va="center",
                    xytext=(4, 0), textcoords="offset points", color=MUTED,
                )  # fmt: skip
        axes.set_yticks(range(len(groups)), [", ".join(names) or "all" for names in groups])
        axes.set_ylim(len(groups) - 0.5, -0.5)
        axes.grid(axis="x")
        has_score = all(run.summary["score"] is not None for run in runs if run.is_done)
        axes.set_xlabel("score" if has_score else "return")
        axes.set_ylabel(", ".join(keys))
        axes.set_title("Runs, means over seeds with 95 % intervals; red: a constraint was broken")
    return save_png(figure, path)
