"""Figures and report from kept records: ``python -m experiments.paper.report``.

Draws ``images/*.png`` and writes ``README.md`` beside them. The same data give the same bytes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.paper.claims import AIMS, BASELINE_CLAIMS, FLOW_CLAIMS, Claim
from experiments.paper.fields import RecordError
from experiments.paper.figures import FIGURES, draw_figures
from experiments.paper.figures_flow import UNTRAINED, KeptPolicy, find_policy
from experiments.paper.hostile import KEPT as KEPT_HOSTILE
from experiments.paper.hostile import HostileRun, load_hostile
from experiments.paper.intersections import FLOWS
from experiments.paper.judgments import Evidence
from experiments.paper.labels import in_order, label
from experiments.paper.records import Record, load_records
from experiments.paper.report_tables import (
    afterwards_table,
    hostile_table,
    methods_table,
    provenance,
    table,
    violations_table,
)
from experiments.paper.statistics import by_method
from experiments.paper.verdicts import Verdict

HERE = Path(__file__).parent
DATA, RUNS, IMAGES, REPORT, POLICY = "data", "runs", "images", "README.md", "policy.json"

_SHORT = {"squash": "chain", "exact": "exact"}
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
        records: those that can be used, one or more.
        problems: a sentence for whatever cannot.
        hostile: what hostile networks did.
        policy: whose flow is drawn.
    """

    records: list[Record]
    problems: list[str]
    hostile: list[HostileRun]
    policy: KeptPolicy


def write_report(data: Path, output: Path) -> Path:
    """Draw the figures and write the report, and return where it is.

    Args:
        data: folder of records.
        output: folder for ``README.md`` and ``images/``. The pictures of the flow take their
            Gaussians from its ``policy.json``, or from a finished run in its ``runs/``.

    Raises:
        RecordError: when there is no usable record at all, naming what is wrong.
    """
    gathered = gather(data, output)
    draw_figures(gathered.records, gathered.hostile, gathered.policy, output / IMAGES)
    path = output / REPORT
    path.write_text(compose(gathered), encoding="utf-8")
    return path


def gather(data: Path, output: Path, *, hostile: Path = KEPT_HOSTILE) -> Gathered:
    """Read everything, and name what cannot be used.

    Args:
        data: see `write_report`.
        output: see `write_report`.
        hostile: the kept result of ``experiments/hostile_networks.py``.

    Raises:
        RecordError: see `write_report`.
    """
    records, problems = load_records(data)
    if not records:
        reasons = "\n".join(problems) or "the folder is empty or missing"
        raise RecordError(f"{data}: expected a record or more, METHOD/seed_S.json, but {reasons}")
    tried, policy = list[HostileRun](), UNTRAINED
    try:
        tried = load_hostile(hostile)
    except RecordError as error:
        problems.append(f"{error} (left out)")
    try:
        policy = find_policy(output / POLICY, output / RUNS)
    except (OSError, ValueError) as error:
        problems.append(f"{error} (the flow is drawn with {UNTRAINED.source})")
    # Where these folders stand on this machine is nothing to readers.
    for folder in (data, output, hostile.parent):
        problems = [each.replace(f"{folder}/", "") for each in problems]
    return Gathered(records, problems, tried, policy)


def compose(gathered: Gathered) -> str:
    """Return the report's text."""
    runs = by_method(gathered.records)
    evidence = Evidence({name: runs[name] for name in in_order(runs)}, gathered.hostile)
    source, problems = gathered.policy.source, gathered.problems
    captions = {name: text.format(source=source) for name, (_, text) in FIGURES.items()}
    parts = [
        "# The paper's experiment, repeated",
        "Constrained 2D point navigation (Rietz et al. 2024, arXiv 2405.01198), with the methods "
        "of the paper, the exact flow of this library and a projection. A command writes this page "
        "from the records in `data/`, every verdict by a rule that stands below; no number and no "
        "verdict is written by hand. Values are interquartile means over seeds, "
        "in brackets their 95 % bootstrap intervals.",
        _warning(problems),
        "## At a glance",
        _image("trade_off", captions),
        methods_table(evidence.runs),
        "Score 0 is standing still, 1 a heuristic planner projected into the sets; 400 episodes "
        "after training. Area: mean score while training. Steps and processor seconds: until the "
        "training score first was 0.75; where a run never was, how many were.",
        violations_table(evidence.runs),
        "## The paper's claims",
        "About its flow, judged for the paper's own chain of squashes and for the exact flow:",
        _flow_claims(evidence),
        "About the other methods:",
        _claims(BASELINE_CLAIMS, evidence, {each: each.value for each in Verdict}),
        "### The rules",
        _rules(),
        "## What the exact flow has to reach",
        _claims(
            AIMS, evidence, AIM_WORDS, kind="aim", first=1 + len(FLOW_CLAIMS) + len(BASELINE_CLAIMS)
        ),
        "## Training",
        _image("training", captions),
        _image("violations_per_episode", captions),
        "## Interquartile means and intervals",
        _image("summary", captions),
        "## A constraint switched on after training",
        _image("afterwards", captions),
        afterwards_table(evidence.runs),
        "## Hostile networks",
        _image("hostile", captions) if gathered.hostile else "",
        hostile_table(gathered.hostile),
        "## The flow, stage by stage",
        *(_image(name, captions) for name in ("flow", "permissive", "restrictive", "mappings")),
        "## What was left out",
        "\n".join(f"- {each}" for each in problems) or "Nothing.",
        "## How it was measured",
        provenance(evidence.runs),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _warning(problems: Sequence[str]) -> str:
    if not problems:
        return ""
    count = f"{len(problems)} problem" + ("s" if len(problems) > 1 else "")
    return f"> **{count} with the data**: see [what was left out](#what-was-left-out)."


def _rules() -> str:
    rules = [each.rule for each in FLOW_CLAIMS]
    rules += [each.rule for each in (*BASELINE_CLAIMS, *AIMS)]
    return "\n".join(f"{i}. {each[0].upper()}{each[1:]}." for i, each in enumerate(rules, start=1))


def _flow_claims(evidence: Evidence) -> str:
    rows = []
    for i, claim in enumerate(FLOW_CLAIMS, start=1):
        found = {flow: claim.judge(evidence, flow) for flow in FLOWS}
        said = [f"{_SHORT[flow]}: {each.measured}" for flow, each in found.items()]
        if len({each.measured for each in found.values()}) == 1:
            said = [found[FLOWS[0]].measured]
        verdicts = [f"**{each.verdict.value}**" for each in found.values()]
        rows.append([str(i), claim.statement, *verdicts, "<br>".join(said)])
    heads = [label(flow).look.label for flow in FLOWS]
    return table(["", "claim", *heads, "measured"], rows)


def _claims(
    claims: Sequence[Claim],
    evidence: Evidence,
    words: Mapping[Verdict, str],
    *,
    kind: str = "claim",
    first: int = 1 + len(FLOW_CLAIMS),
) -> str:
    rows = []
    for i, claim in enumerate(claims, start=first):
        found = claim.judge(evidence)
        rows.append([str(i), claim.statement, f"**{words[found.verdict]}**", found.measured])
    return table(["", kind, "verdict", "measured"], rows)


def _image(name: str, captions: Mapping[str, str]) -> str:
    return f"![{FIGURES[name][0]}]({IMAGES}/{name}.png)\n\n*{captions[name]}*"


def main(arguments: Sequence[str] | None = None) -> int:
    """Redraw and rewrite; return 1 where nothing can be drawn."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.paper.report", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--data", type=Path, default=HERE / DATA, help="folder of records")
    parser.add_argument("--output", type=Path, default=HERE, help="folder of report and images")
    options = parser.parse_args(arguments)
    try:
        path = write_report(options.data, options.output)
    except RecordError as error:
        sys.stderr.write(f"error: {error}\n")
        return 1
    sys.stdout.write(f"{path}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
