"""Figures and pages from kept records: ``python -m experiments.paper.report [FOLDER]``.

Draws ``images/*.png`` from ``data/``, and writes ``README.md`` and ``details.md`` beside them. The
same data give the same bytes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from cnfp_torchrl.text_table import markdown_table
from cnfp_torchrl.visual.figures.canvas import save_png
from experiments.paper.claims import (
    AIMS,
    BASELINE_CLAIMS,
    FLOW_CLAIMS,
    FLOWS,
    Claim,
    Evidence,
    Finding,
    Verdict,
)
from experiments.paper.figures_flow import UNTRAINED, KeptPolicy, find_policy, flow_figures
from experiments.paper.figures_mappings import draw_mappings
from experiments.paper.figures_methods import (
    draw_afterwards,
    draw_hostile,
    draw_summary,
    draw_trade_off,
    draw_training,
    draw_violation_rates,
)
from experiments.paper.labels import in_order, label
from experiments.paper.records import HostileRuns, RecordError, by_method, load_records
from experiments.paper.statistics import TARGET_SCORE
from experiments.paper.tables import (
    afterwards_table,
    configurations_table,
    hostile_table,
    methods_table,
    provenance,
    speed_table,
    violations_table,
)

HERE = Path(__file__).parent
HOSTILE = HERE.parent / "results" / "hostile_networks.json"

AIM_WORDS = {
    Verdict.YES: "met",
    Verdict.PARTLY: "partly",
    Verdict.NO: "not met",
    Verdict.UNTESTED: "not tested",
}


@dataclass(frozen=True)
class Gathered:
    """Everything that the report is made of.

    Args:
        evidence: The records that can be used, one or more, and what hostile networks did.
        problems: A sentence for whatever cannot.
        policy: Whose flow is drawn.
    """

    evidence: Evidence
    problems: Sequence[str]
    policy: KeptPolicy


@dataclass(frozen=True)
class Judged:
    """A claim and what was found.

    Args:
        kind: "Claim" of the paper, or "Aim" of this project.
        number: The number of all claims and aims.
        claim: What is claimed.
        found: What was found by flow.
    """

    kind: str
    number: int
    claim: Claim
    found: Mapping[str, Finding]

    def verdict(self, flow: str) -> str:
        """Return the verdict about a flow in words, bold where the claim holds."""
        verdict = self.found[flow].verdict
        word = AIM_WORDS[verdict] if self.kind == "Aim" else verdict.value
        return f"**{word}**" if verdict is Verdict.YES else word


def write_report(folder: Path) -> Path:
    """Draw the figures and write the pages, and return where the first is.

    Args:
        folder: The folder with records in ``data/``. The pictures of the flow take their Gaussians
            from its ``policy.json``, or from a finished run in its ``runs/``.

    Raises:
        RecordError: when there is no usable record at all, naming what is wrong.
    """
    gathered = gather(folder)
    for name, figure in draw_figures(gathered).items():
        save_png(figure, folder / "images" / f"{name}.png", dpi=96)
    for name, page in pages(gathered).items():
        (folder / name).write_text(page, encoding="utf-8")
    return folder / "README.md"


def gather(folder: Path, *, hostile: Path = HOSTILE) -> Gathered:
    """Read everything, and name what cannot be used.

    Args:
        folder: See `write_report`.
        hostile: The kept result of ``experiments/hostile_networks.py``.

    Raises:
        RecordError: see `write_report`.
    """
    data = folder / "data"
    records, problems = load_records(data)
    if not records:
        reasons = "\n".join(problems) or "the folder is empty or missing"
        raise RecordError(f"{data}: expected a record or more, METHOD/seed_S.json, but {reasons}")
    flows, policy = {}, UNTRAINED
    try:
        flows = HostileRuns.read(hostile).by_flow()
    except RecordError as error:
        problems.append(f"{error} (left out)")
    try:
        policy = find_policy(folder / "policy.json", folder / "runs")
    except (OSError, ValueError) as error:
        problems.append(f"{error} (the flow is drawn with {UNTRAINED.source})")
    # Where these folders stand on this machine is nothing to readers.
    for path in (data, folder, hostile.parent):
        problems = [problem.replace(f"{path}/", "") for problem in problems]
    runs = by_method(records)
    return Gathered(
        Evidence({name: runs[name] for name in in_order(runs)}, flows), problems, policy
    )


def draw_figures(gathered: Gathered) -> dict[str, Figure]:
    """Return every figure for which there is data, by name."""
    runs, hostile = gathered.evidence.runs, gathered.evidence.hostile
    return {
        "trade_off": draw_trade_off(runs),
        "training": draw_training(runs),
        "violations_per_episode": draw_violation_rates(runs),
        "summary": draw_summary(runs),
        "afterwards": draw_afterwards(runs),
        **({"hostile": draw_hostile(hostile)} if hostile else {}),
        **flow_figures(gathered.policy),
        "mappings": draw_mappings(),
    }


def pages(gathered: Gathered) -> dict[str, str]:
    """Return the text of both pages by the names of their files."""
    judged = list(judge(gathered.evidence))
    return {
        "README.md": "\n\n".join(_page(gathered, judged)) + "\n",
        "details.md": "\n\n".join(_details(gathered, judged)) + "\n",
    }


def judge(evidence: Evidence) -> Iterator[Judged]:
    """Yield every claim with what the evidence says of it, for each flow that it is about."""
    for i, claim in enumerate((*FLOW_CLAIMS, *BASELINE_CLAIMS, *AIMS)):
        flows = FLOWS if claim in FLOW_CLAIMS else ("exact",)
        found = {flow: claim.judge(evidence, flow) for flow in flows}
        yield Judged("Aim" if claim in AIMS else "Claim", 1 + i, claim, found)


def _page(gathered: Gathered, judged: Sequence[Judged]) -> Iterator[str]:
    evidence, problems = gathered.evidence, gathered.problems
    runs, source = evidence.runs, gathered.policy.source
    every = [run for records in runs.values() for run in records]
    episodes = _values(run.evaluation.stochastic.episodes for run in every)
    yield "# The paper's experiment, repeated"
    yield (
        "Constrained 2D point navigation ([Rietz et al. 2024](https://arxiv.org/abs/2405.01198)) "
        "with the methods of the paper, the exact flow of this library and a projection: "
        f"{len(every)} runs, of {_values(run.steps for run in every)} environment steps each. A "
        "command writes this page from the records in `data/`, every "
        "verdict by a [rule](details.md#claims-and-rules); no number and no verdict is written by "
        "hand."
    )
    if problems:
        count = f"{len(problems)} problem" + ("s" if len(problems) > 1 else "")
        yield f"> **{count} with the data**: see [what was left out](details.md#what-was-left-out)."
    yield "## The methods"
    yield methods_table(runs)
    yield (
        "Interquartile means over seeds, in brackets their 95 % bootstrap intervals. Score 0 is "
        f"standing still, 1 a heuristic planner projected into the sets; {episodes} episodes after "
        f"training. Steps: until the score in training first was {TARGET_SCORE:g}; where some run "
        "never was, how many were. Violating steps: of training and evaluations, all constraints "
        "together. [All numbers](details.md#all-numbers)."
    )
    yield _image(
        "trade_off",
        "Score against violations for all methods",
        "Each dot is a run, each mark a method. 0 violations stands on the axis.",
    )
    yield "## The paper's claims"
    yield "The number of a claim leads to its rule and to what was measured."
    about_flow, others = judged[: len(FLOW_CLAIMS)], judged[len(FLOW_CLAIMS) :]
    heads = [label(flow).name for flow in FLOWS]
    yield _claims(["about its flow", *heads], about_flow)
    yield _claims(["about the other methods", "verdict"], [j for j in others if j.kind == "Claim"])
    yield "What the exact flow has to reach beyond that:"
    yield _claims(["aim", "verdict"], [other for other in others if other.kind == "Aim"])
    yield "## Training"
    yield _image(
        "training",
        "Return and cumulative violations over training",
        "The paper's fourth figure. Methods that coincide at 0 are told by their markers.",
    )
    yield _image(
        "violations_per_episode",
        "Violating steps per episode over training",
        "Each round of episodes, which all agents end together. Axes are linear below 0.1.",
    )
    yield _image(
        "summary",
        "Scores, areas, speed and violations with intervals",
        "Faint dots are the runs. A method of which some run never reached the score has no mean "
        "there.",
    )
    yield "## A constraint switched on after training"
    yield _image(
        "afterwards",
        "Return and violations after a change of the constraints",
        "Trained policies, stochastic, in the task as it was and in two changed ones, without "
        "another step of training. [In numbers](details.md#after-a-change).",
    )
    yield "## Hostile networks"
    if evidence.hostile:
        yield _image(
            "hostile",
            "Violations of hostile networks behind each flow",
            "Untrained networks and networks made to break constraints, with means up to a "
            "million. [In numbers](details.md#behind-hostile-networks).",
        )
    yield "## The flow, stage by stage"
    yield _image(
        "flow",
        "The flow on the map",
        "The paper's first figure. The last caption counts among a million fresh samples.",
    )
    yield _image(
        "permissive",
        "The flow in a permissive state",
        "The paper's third figure, top: nothing near, battery full.",
    )
    yield _image(
        "restrictive",
        "The flow in a restrictive state",
        "The paper's third figure, bottom: at a wall, with two steps of battery left.",
    )
    yield f"The Gaussian in these three: {source}."
    yield _image(
        "mappings",
        "Particles before and after each mapping",
        "The paper's second figure: its squashes in the first row, then a retraction and the exact "
        "flow into further sets, within the dashed action bounds; a shell has a squash of its own. "
        "A particle keeps its color.",
    )
    yield "[How it was measured](details.md#how-it-was-measured), and how to repeat it."


def _details(gathered: Gathered, judged: Sequence[Judged]) -> Iterator[str]:
    evidence = gathered.evidence
    runs = evidence.runs
    yield "# Rules, measurements and provenance"
    yield "Behind [the paper's experiment, repeated](README.md)."
    yield "## Claims and rules"
    for judgment in judged:
        claim = judgment.claim
        yield f"### {judgment.kind} {judgment.number}"
        yield f"{claim.statement} *{claim.rule[0].upper()}{claim.rule[1:]}.*"
        yield "\n".join(
            (f"- {label(flow).name}: " if len(judgment.found) > 1 else "- ")
            + f"{judgment.verdict(flow)}; {finding.measured}"
            for flow, finding in judgment.found.items()
        )
    yield "## All numbers"
    yield "Score and its speed are in [the first table](README.md#the-methods)."
    yield "### Area and time"
    yield "Area: mean score while training."
    yield speed_table(runs)
    yield "### Violations"
    yield violations_table(runs)
    yield "### After a change"
    yield afterwards_table(runs)
    yield "### Behind hostile networks"
    yield hostile_table(evidence.hostile)
    yield "Each network is in `experiments/results/hostile_networks.md`."
    yield "## What was left out"
    yield "\n".join(f"- {problem}" for problem in gathered.problems) or "Nothing."
    yield "## How it was measured"
    yield configurations_table(runs)
    yield "Names of classes are those of the commits."
    yield provenance(runs)


def _claims(head: Sequence[str], judged: Sequence[Judged]) -> str:
    rows = [
        [
            f"[{judgment.number}](details.md#{judgment.kind.lower()}-{judgment.number})",
            judgment.claim.statement,
            *map(judgment.verdict, judgment.found),
        ]
        for judgment in judged
    ]
    return markdown_table([["", *head], *rows])


def _values(numbers: Iterable[int]) -> str:
    """Return the smallest and the largest of some numbers in words, once where they agree."""
    ordered = sorted(numbers)
    return " to ".join(f"{end:,}" for end in dict.fromkeys((ordered[0], ordered[-1])))


def _image(name: str, title: str, caption: str) -> str:
    return f"![{title}](images/{name}.png)\n\n*{caption}*"


def main(arguments: Sequence[str] | None = None) -> int:
    """Redraw and rewrite; return 1 where nothing can be drawn."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.paper.report", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument(
        "folder", type=Path, nargs="?", default=HERE, help="with records in data/ (%(default)s)"
    )
    try:
        path = write_report(parser.parse_args(arguments).folder)
    except RecordError as error:
        sys.stderr.write(f"error: {error}\n")
        return 1
    sys.stdout.write(f"{path}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
