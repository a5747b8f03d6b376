"""Draw the kept records of training, and write what they say into the page.

    python -m experiments.field.report [--data FOLDER] [--page FILE]

Changes ``images/training.png`` beside the page, and what stands in the page between its two marks.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from experiments.field.jobs import (
    ACTION_SIZES,
    DATA,
    FOLDER,
    METHODS,
    ONE_SEED,
    OURS,
    RANDOM_ACTIONS,
    SAFE_CONTROL,
    TRAINED,
)
from experiments.field.records import Record, read_records

PAGE = FOLDER / "README.md"
BEGIN, END = "<!-- results: by report.py -->", "<!-- end of results -->"
BINS = 20
"""Points of a curve."""
EPISODE = 1000
"""Steps of an episode that does not end early."""


class Label(NamedTuple):
    """How a method is called and drawn."""

    text: str
    color: str


LABELS = {
    "hard": Label("exact flow, hard retraction", "#0072B2"),
    "soft": Label("exact flow, soft retraction", "#D55E00"),
    "sharp": Label("exact flow, soft retraction of sharpness 4", "#E69F00"),
    "projection": Label("projection in the policy", "#009E73"),
    "sb3_projection": Label("Stable-Baselines3, projection in the environment", "#CC79A7"),
    "unconstrained": Label("unconstrained", "#5A5A5A"),
}
TITLES = {
    "half_cheetah_power": "HalfCheetah, limited power",
    "half_cheetah_rate": "HalfCheetah, limited rate",
    "hopper_mixed": "Hopper, limits of power and effort",
}


def curve(record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Return steps and returns of training's policy.

    Where episodes never end early, rewards times the length of an episode; else the mean return of
    the episodes that ended between two points.
    """
    edges = np.linspace(0, record.steps, BINS + 1)
    ends, returns = np.array(record.episode_steps), np.array(record.episode_returns)
    if record.steps > 0.9 * EPISODE * len(ends):
        ends, returns = np.array(record.reward_steps), np.array(record.rewards) * EPISODE
    places = np.clip(np.digitize(ends, edges[1:], right=True), 0, BINS - 1)
    kept = [index for index in range(BINS) if (places == index).any()]
    return edges[1:][kept], np.array([returns[places == index].mean() for index in kept])


def draw(records: Sequence[Record], path: Path) -> None:
    """Draw a panel for each task: medians over seeds, and bands from the least to the most."""
    figure = Figure(figsize=(11, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    panels: Sequence[Axes] = figure.subplots(1, len(TRAINED))
    for axes, task in zip(panels, TRAINED, strict=True):
        for method, label in LABELS.items():
            chosen = [run for run in records if (run.task, run.method) == (task, method)]
            if not chosen:
                continue
            curves = [curve(run) for run in chosen]
            common = sorted(set.intersection(*(set(steps) for steps, _ in curves)))
            values = np.array([np.interp(common, *points) for points in curves])
            style = "--" if method == "unconstrained" else "-"
            axes.plot(common, np.median(values, 0), style, color=label.color, label=label.text)
            axes.fill_between(
                common, values.min(0), values.max(0), color=label.color, alpha=0.15, linewidth=0
            )
        axes.set_title(TITLES[task], fontsize=10)
        axes.set_xlabel("environment steps")
        axes.spines[["top", "right"]].set_visible(False)
        axes.ticklabel_format(style="sci", scilimits=(0, 4))
    panels[0].set_ylabel("return of the policy in training")
    shown = {
        text: handle
        for axes in panels
        for handle, text in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        shown.values(), shown.keys(), loc="outside lower center", ncols=3, frameon=False, fontsize=9
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def spread(values: Sequence[float], digits: int = 0) -> str:
    """Return the median, and the least and most of several values."""
    text = f"{median(values):,.{digits}f}"
    if len(values) == 1:
        return text
    return f"{text} [{min(values):,.{digits}f}, {max(values):,.{digits}f}]"


def training_table(records: Sequence[Record], task: str) -> list[str]:
    """Return a task's table."""
    lines = [
        f"### {TITLES[task]}",
        "",
        "| method | seeds | greedy return | stochastic return | violations | relaxed | moved "
        "| ms an action | steps/s | points projected |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for method in LABELS:
        chosen = [run for run in records if (run.task, run.method) == (task, method)]
        if not chosen:
            continue
        greedy, stochastic = (
            spread([float(np.mean(getattr(run, kind).returns)) for run in chosen])
            for kind in ("greedy", "stochastic")
        )
        relaxed = max(max(run.relaxed.values(), default=0.0) for run in chosen)
        moved = median(run.stochastic.moved for run in chosen)
        cells = [
            LABELS[method].text,
            str(len(chosen)),
            greedy,
            stochastic,
            f"{max(run.all_violations for run in chosen):,}",
            f"{relaxed:.1%}",
            f"{moved:.0%}",
            f"{median(run.milliseconds for run in chosen):.2f}",
            f"{median(run.steps_per_second for run in chosen):.0f}",
            f"{median(run.projections for run in chosen):,.0f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return [*lines, "", *compared(records, task)]


def compared(records: Sequence[Record], task: str) -> list[str]:
    """Return a sentence on the best of ours and the best peer, by the median stochastic return."""
    found: dict[bool, tuple[float, str]] = {}
    for method, label in LABELS.items():
        returns = [
            float(np.mean(run.stochastic.returns))
            for run in records
            if (run.task, run.method) == (task, method)
        ]
        if returns and method not in ONE_SEED:
            is_ours, result = method in OURS, (median(returns), label.text)
            found[is_ours] = max(found.get(is_ours, result), result)
    if len(found) < 2:
        return []
    (mine, my_name), (theirs, their_name) = found[True], found[False]
    verdict = "at least that of" if mine >= theirs else "below"
    return [
        f"Of these runs, the best of ours by stochastic return ({my_name}) has {mine:,.0f}, "
        f"{verdict} the best constrained peer's ({their_name}), {theirs:,.0f}.",
        "",
    ]


def random_table(rows: list[dict[str, Any]]) -> list[str]:
    """Return the table of random actions."""
    lines = [
        "## Random actions",
        "",
        "The exact flow on latents of magnitudes from 0.01 to 1e6, float32 actions, judged on the "
        "simulator's own state with zero tolerance. Coverage: the share of what the judges allow "
        "that lies in the sets.",
        "",
        "| task | steps | violations | relaxed | coverage | actions drawn for it |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        cells = [
            f"`{row['task']}`",
            f"{row['steps']:,}",
            f"{sum(row['violations'].values())}",
            f"{max(row['relaxed'].values()):.1%}",
            "-" if row["coverage"] is None else f"{row['coverage']:.2%}",
            f"{row['drawn_and_allowed']:,}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    made_with = sorted({f"torch {r['about']['torch']}, {r['about']['machine']}" for r in rows})
    commands = {" ".join(f"--{key} {value}" for key, value in r["settings"].items()) for r in rows}
    made_by = "; ".join(
        f"`python -m experiments.field.random_actions {c}`" for c in sorted(commands)
    )
    return [*lines, "", f"{made_by}; {'; '.join(made_with)}.", ""]


AIM = 500.0
"""The objective of safe control to reach."""

CONTROLLERS = {
    "recession": "recession (ours)",
    "hardnet_aff": "HardNet-Aff, re-implemented",
    "cbf_qp": "CBF-QP, which learns nothing",
}


def aim(runs: list[dict[str, Any]]) -> list[str]:
    """Return a sentence for each learning rate on how far our controllers are from the aim."""
    lines = []
    for rate in sorted({run["rate"] for run in runs}):
        chosen = [run for run in runs if run["rate"] == rate]
        objective = median(run["objective"] for run in chosen)
        broken = sum(run["violations"] for run in chosen)
        reached = sum(run["objective"] <= AIM for run in chosen)
        off = f"{objective - AIM:.1f} above" if objective > AIM else f"{AIM - objective:.1f} below"
        lines += [
            f"At a rate of {rate:g}, with {broken} violations, the median of ours is {off} the aim "
            f"of {AIM:g}, which {reached} of {len(chosen)} seeds reach.",
            "",
        ]
    return lines


def safe_control_table(runs: list[dict[str, Any]], times: dict[str, Any] | None) -> list[str]:
    """Return the table of controllers trained through layers."""
    lines = [
        "## Safe control",
        "",
        "HardNet's unicycle past two ellipses (Min and Azizan 2024, "
        "[arXiv 2410.10807](https://arxiv.org/abs/2410.10807)), in float64 and with the published "
        "starts (seed 17), network, batches and learning rate. Objective: the mean cost of the 84 "
        "starts of the test, medians over seeds [least, most]. Violations: controls of the test "
        "that broke a barrier, with zero tolerance, by a judge that shares no formula with the "
        "rows. By HardNet's own measure: excesses over a barrier, integrated over an episode; the "
        "largest, and the number of barriers beyond 1e-4, means over starts. The aim: an objective "
        "of at most 500 without a violation, no slower than HardNet-Aff.",
        "",
        "| controller | epochs | learning rate | seeds | objective | violations | largest excess "
        "| barriers beyond 1e-4 |",
        "|---|---|---|---|---|---|---|---|",
    ]
    kinds = sorted({(run["rate"], list(CONTROLLERS).index(run["layer"])) for run in runs})
    for rate, place in kinds:
        name, title = list(CONTROLLERS.items())[place]
        chosen = [run for run in runs if (run["layer"], run["rate"]) == (name, rate)]
        learns = any(run["epochs"] for run in chosen)
        cells = [
            title,
            str(max(run["epochs"] for run in chosen)),
            f"{rate:g}" if learns else "-",
            str(len(chosen)),
            spread([run["objective"] for run in chosen], 1),
            f"{sum(run['violations'] for run in chosen):,}",
            f"{max(run['excess']['largest'] for run in chosen):.3g}",
            f"{max(run['excess']['count'] for run in chosen):.3g}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    lines += [
        "",
        "Published: HardNet-Aff 518.85 (8.71) after 1,000 epochs, a soft penalty 480 with "
        "violations, CBF-QP 948 (its baseline adds the nominal control twice).",
        "",
        *aim([run for run in runs if run["layer"] == "recession"]),
    ]
    if times is not None:
        forward, backward = times["forward"], times["backward"]
        lines += [
            f"Network, rows and layer of {times['states']} states take "
            f"{forward['recession']:.2f} ms ({forward['ratio']:.2f} times HardNet-Aff's, in the "
            f"same turn), with the gradient {backward['recession']:.2f} ms "
            f"({backward['ratio']:.2f} times); processor time, "
            f"medians of {times['turns']} turns, `python -m experiments.field.safe_control times`; "
            f"torch {times['about']['torch']}, {times['about']['machine']}.",
            "",
        ]
    return lines


def results(data: Path, page: Path) -> str:
    """Return what stands between the marks, and draw the figure it shows."""
    lines: list[str] = []
    if records := read_records(data):
        draw(records, page.parent / "images" / "training.png")
        steps = {run.steps for run in records}
        made_with = sorted(
            {
                "torch {torch}, TorchRL {torchrl}, MuJoCo {mujoco}; {machine}, {device}".format(
                    **run.about
                )
                for run in records
            }
        )
        lines += [
            "## Training",
            "",
            "![Returns over training](images/training.png)",
            "",
            f"{max(steps):,} steps of SAC, 8 robots together, width 256, batch 256, half an update "
            "a step, the same of all methods; medians over the seeds that have a record [least, "
            "most], each the mean of 8 episodes; violations "
            "of the worst run, training and both evaluations together; one seed of unconstrained. "
            "Moved: the share of drawn actions that the constraints changed by more than 0.001. "
            "Milliseconds are those of one state, from its observation to the action, on a busy "
            "machine; steps a second those of training, other runs beside it.",
            "",
            *(line for task in TRAINED for line in training_table(records, task)),
            f"One thread a run: {' | '.join(made_with)}.",
            "",
        ]
    paths = [data / RANDOM_ACTIONS / f"{task}.json" for task in ACTION_SIZES]
    if rows := [json.loads(path.read_text()) for path in paths if path.exists()]:
        lines += random_table(rows)
    folder = data / SAFE_CONTROL
    if runs := [json.loads(path.read_text()) for path in sorted(folder.glob("*/*.json"))]:
        taken = folder / "times.json"
        times = json.loads(taken.read_text()) if taken.exists() else None
        lines += safe_control_table(runs, times)
    return "\n".join(lines)


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the records")
    parser.add_argument("--page", type=Path, default=PAGE, help="the page to change")
    given = parser.parse_args()
    before, _, rest = given.page.read_text().partition(BEGIN)
    _, mark, after = rest.partition(END)
    if not mark:
        raise SystemExit(f"{given.page}: expected the marks {BEGIN!r} and {END!r}")
    text = f"{before}{BEGIN}\n\n{results(given.data, given.page)}\n{END}{after}"
    given.page.write_text(text)


assert set(LABELS) == set(METHODS)

if __name__ == "__main__":
    main()
