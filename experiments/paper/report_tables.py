"""Tables of the report, in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from experiments.paper.differences import in_words
from experiments.paper.hostile import HostileRun, by_flow
from experiments.paper.labels import in_order, label
from experiments.paper.records import MODES, Outcome, Record
from experiments.paper.statistics import (
    BOOTSTRAP_SEED,
    CONFIDENCE,
    RESAMPLES,
    Interval,
    interquartile_mean,
    summarise,
)
from experiments.paper.verdicts import interval

Runs = Mapping[str, Sequence[Record]]
"""The records of each method, in the order in which they are shown."""

STOCHASTIC, DETERMINISTIC = MODES


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table; bars within cells are escaped."""
    lines = [[cell.replace("|", "\\|") for cell in row] for row in (head, *rows)]
    rule = ["---"] * len(head)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (lines[0], rule, *lines[1:]))


def methods_table(runs: Runs) -> str:
    """Return score, area and speed of every method."""
    rows = []
    for method, records in runs.items():
        each = summarise(records)
        rows.append(
            [
                label(method).look.label,
                str(len(records)),
                interval(each.score[STOCHASTIC]),
                interval(each.score[DETERMINISTIC]),
                interval(each.area),
                _reached(each.steps_to_score, each.reached, len(records)),
                _reached(each.processor_seconds_to_score, each.reached, len(records)),
                interval(interquartile_mean([run.seconds for run in records]), 0),
            ]
        )
    head = ["method", "runs", "score, stochastic", "score, deterministic", "area"]
    return table([*head, "steps to 0.75", "processor seconds to 0.75", "seconds of a run"], rows)


def violations_table(runs: Runs) -> str:
    """Return violating steps of every method: training, evaluation, start and end."""
    constraints = next(iter(runs.values()))[0].constraints
    rows = []
    for method, records in runs.items():
        cells = [label(method).look.label]
        for name in constraints:
            training = interquartile_mean([run.training_violations[name] for run in records])
            evaluated = interquartile_mean([_evaluated(run, name) for run in records])
            cells += [interval(training, 0), interval(evaluated, 0)]
        start, end = summarise(records).violations_per_episode
        cells += [interval(start), interval(end), _worst(records)]
        rows.append(cells)
    head = ["violating steps per run"]
    for name in constraints:
        head += [f"{name}, training", f"{name}, evaluation"]
    head += ["per episode, first tenth", "per episode, last tenth", "most in one run"]
    return table(head, rows)


def afterwards_table(runs: Runs) -> str:
    """Return return and violations of every method before and after each change."""
    changes = dict.fromkeys(
        name for records in runs.values() for run in records for name in run.afterwards
    )
    rows = []
    for method, records in runs.items():
        cells = [label(method).look.label]
        outcomes = [run.evaluation[STOCHASTIC] for run in records]
        cells += [_returned(outcomes), _broken(outcomes)]
        for change in changes:
            later = [r.afterwards[change][STOCHASTIC] for r in records if change in r.afterwards]
            cells += [_returned(later), _broken(later)]
        rows.append(cells)
    head = ["stochastic policy", "return, as trained", "violating steps"]
    for change in changes:
        head += [f"return, {change}", "violating steps"]
    return table(head, rows) if changes else "No run was evaluated after a change."


def hostile_table(runs: Sequence[HostileRun]) -> str:
    """Return the violations of hostile networks behind each flow."""
    if not runs:
        return "No result is kept."
    flows = by_flow(runs)
    constraints = list(runs[0].violations)
    rows = [
        [
            label(name).look.label,
            str(len(flows[name])),
            f"{sum(run.steps for run in flows[name]):,}",
            *(f"{sum(run.violations[each] for run in flows[name]):,}" for each in constraints),
        ]
        for name in in_order(flows)
    ]
    return table(["flow", "networks", "steps", *constraints], rows)


def provenance(runs: Runs) -> str:
    """Return budget, seeds, versions, commits and commands."""
    every = [run for records in runs.values() for run in records]
    versions = {
        name: _all_of(run.versions.get(name, "unknown") for run in every)
        for name in dict.fromkeys(name for run in every for name in run.versions)
    }
    budgets = _all_of(f"{run.steps:,}" for run in every)
    commits = _all_of("unknown" if run.commit is None else run.commit[:12] for run in every)
    rows = [
        [
            label(method).look.label,
            f"`experiment={method}`",
            ", ".join(str(run.seed) for run in records),
            _all_of(f"{run.steps:,}" for run in records),
            _all_of(
                " ".join(f"`{o}`" for o in run.overrides) or "unconstrained" for run in records
            ),
            _all_of(in_words(_shared(every[0]), _shared(run)) for run in records),
        ]
        for method, records in runs.items()
    ]
    heads = ["method", "configuration", "seeds", "training steps", "overrides"]
    heads.append("what differs from the first method's configuration")
    seconds = sum(run.seconds for run in every)
    return "\n\n".join(
        [
            table(heads, rows),
            f"- Budget: {budgets} environment steps a run, {len(every)} runs, "
            f"{seconds / 3600:.1f} hours of wall time one after the other; runs beside each other "
            "slow each other down, processor seconds less so.\n"
            f"- Intervals: percentile bootstrap of the interquartile mean, {RESAMPLES:,} resamples "
            f"of the seeds, {100 * CONFIDENCE:.0f} %, seed {BOOTSTRAP_SEED}; differences resample "
            "both methods. A few seeds bound an interval only roughly.\n"
            f"- Versions: {', '.join(f'{name} {each}' for name, each in versions.items())}; commit "
            f"{commits}.\n"
            "- From nothing: `make paper` (3 seeds, 20,000 steps, into `outputs/paper`); with "
            'other methods, seeds or budgets: `make paper ARGS="--seeds 0-4 --steps 24000"`.\n'
            "- From the kept records: `make figures` redraws this page.",
        ]
    )


def _all_of(values: Iterable[str]) -> str:
    return ", ".join(sorted(set(values)))


def _shared(run: Record) -> dict[str, Any]:
    """Return what a run's configuration shares with those of other seeds."""
    return {name: value for name, value in run.config.items() if name != "seed"}


def _evaluated(run: Record, constraint: str) -> int:
    return sum(outcome.violations[constraint] for outcome in run.evaluation.values())


def _worst(records: Sequence[Record]) -> str:
    return f"{max(sum(run.violations.values()) for run in records):,}"


def _reached(each: Interval | None, count: int, runs: int) -> str:
    return f"{count} of {runs} runs" if each is None else interval(each, 0)


def _returned(outcomes: Sequence[Outcome]) -> str:
    return interval(interquartile_mean([o.return_mean for o in outcomes]), 1) if outcomes else "-"


def _broken(outcomes: Sequence[Outcome]) -> str:
    if not outcomes:
        return "-"
    return interval(interquartile_mean([sum(o.violations.values()) for o in outcomes]), 0)
