"""Tables of the report, in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from cnfp_torchrl.text_table import markdown_table
from experiments.paper.figures_methods import Runs, changes_of
from experiments.paper.labels import in_order, label
from experiments.paper.records import HostileRun, Outcome, differences, without_seed
from experiments.paper.statistics import (
    BOOTSTRAP_SEED,
    CONFIDENCE,
    RESAMPLES,
    TARGET_SCORE,
    Interval,
    Reached,
    area_under_score,
    interquartile_mean,
    reached,
    start_and_end,
)


def methods_table(runs: Runs) -> str:
    """Return what readers ask first of every method: scores, speed, violations."""
    rows = []
    for method, records in runs.items():
        scores = [
            [run.evaluation.stochastic.score for run in records],
            [run.evaluation.deterministic.score for run in records],
        ]
        moments = [reached(run) for run in records]
        rows.append(
            [
                label(method).name,
                *(interquartile_mean(score).text() for score in scores),
                _moment(moments, [moment.steps for moment in moments if moment]),
                f"{max(run.violations for run in records):,}",
            ]
        )
    head = ["method", "score, stochastic", "score, deterministic", f"steps to {TARGET_SCORE:g}"]
    return markdown_table([[*head, "violating steps, worst run"], *rows])


def speed_table(runs: Runs) -> str:
    """Return area and speed of every method."""
    rows = []
    for method, records in runs.items():
        moments = [reached(run) for run in records]
        rows.append(
            [
                label(method).name,
                str(len(records)),
                interquartile_mean([area_under_score(run) for run in records]).text(),
                _moment(moments, [moment.processor_seconds for moment in moments if moment]),
                interquartile_mean([run.seconds for run in records]).text(0),
            ]
        )
    return markdown_table(
        [
            [
                "method",
                "runs",
                "area",
                f"processor seconds to {TARGET_SCORE:g}",
                "seconds of a run",
            ],
            *rows,
        ]
    )


def violations_table(runs: Runs) -> str:
    """Return violating steps of every method: training, evaluation, start and end."""
    constraints = next(iter(runs.values()))[0].constraints
    rows = []
    for method, records in runs.items():
        cells = [label(method).name]
        for name in constraints:
            training = [run.training_violations[name] for run in records]
            evaluated = [sum(o.violations[name] for o in r.evaluation.both) for r in records]
            cells += [_count(training), _count(evaluated)]
        rows.append([*cells, *(record.text() for record in start_and_end(records))])
    head = ["violating steps of a run"]
    for name in constraints:
        head += [f"{name}, training", f"{name}, evaluation"]
    return markdown_table([[*head, "per episode, first tenth", "per episode, last tenth"], *rows])


def afterwards_table(runs: Runs) -> str:
    """Return return and violations of every method's stochastic policy, before and after changes.

    It is a row for each method where some run was evaluated after a change, else a sentence.
    """
    changes = changes_of(runs)
    if not changes:
        return "No run was evaluated after a change."
    rows = []
    for method, records in runs.items():
        cells = [label(method).name, *_outcomes([run.evaluation.stochastic for run in records])]
        for change in changes:
            later = [r.afterwards[change].stochastic for r in records if change in r.afterwards]
            cells += _outcomes(later)
        rows.append(cells)
    head = ["stochastic policy", "return, as trained", "violating steps"]
    for change in changes:
        head += [f"return, {change}", "violating steps"]
    return markdown_table([head, *rows])


def hostile_table(flows: Mapping[str, Sequence[HostileRun]]) -> str:
    """Return the violations of hostile networks behind each flow."""
    if not flows:
        return "No result is kept."
    constraints = list(next(iter(flows.values()))[0].violations)
    rows = [
        [
            label(name).name,
            str(len(flows[name])),
            f"{sum(run.steps for run in flows[name]):,}",
            *(
                f"{sum(run.violations[constraint] for run in flows[name]):,}"
                for constraint in constraints
            ),
        ]
        for name in in_order(flows)
    ]
    return markdown_table([["flow", "networks", "steps", *constraints], *rows])


def configurations_table(runs: Runs) -> str:
    """Return seeds, budget and configuration of every method."""
    usual = without_seed(next(iter(runs.values()))[0])
    rows = [
        [
            label(method).name,
            f"`experiment={method}`",
            ", ".join(str(run.seed) for run in records),
            f"{records[0].steps:,}",
            in_words(differences(usual, without_seed(records[0]))),
        ]
        for method, records in runs.items()
    ]
    head = ["method", "configuration", "seeds", "training steps"]
    return markdown_table([[*head, "what differs from the first method's configuration"], *rows])


def in_words(apart: Mapping[str, tuple[str | None, str | None]]) -> str:
    """Return, as Markdown, what is special about a configuration by its `differences`."""
    said = []
    for name, (_, value) in apart.items():
        what = name.removesuffix("._target_")
        if value is None and any(result.startswith(f"{name}.") for result in apart):
            continue
        if value is not None and what != name:
            value = value.strip('"').rpartition(".")[2]
        said.append(f"`{what}: {'absent' if value is None else value}`")
    return ", ".join(said) or "nothing"


def provenance(runs: Runs) -> str:
    """Return how intervals are had, and of what code and machine the records are."""
    every = [run for records in runs.values() for run in records]
    names = dict.fromkeys(name for run in every for name in run.versions)
    versions = {name: _all_of(run.versions.get(name, "unknown") for run in every) for name in names}
    commits = _all_of("unknown" if run.commit is None else run.commit[:12] for run in every)
    seconds = sum(run.seconds for run in every)
    return (
        f"- Budget: {len(every)} runs, {seconds / 3600:.1f} hours of wall time one after the "
        "other; runs beside each other slow each other down, processor seconds less so.\n"
        f"- Intervals: percentile bootstrap of the interquartile mean, {RESAMPLES:,} resamples "
        f"of the seeds, {100 * CONFIDENCE:.0f} %, seed {BOOTSTRAP_SEED}; differences resample "
        "both methods. A few seeds bound an interval only roughly.\n"
        f"- Versions: {', '.join(map(' '.join, versions.items()))}; commit {commits}.\n"
        "- From nothing: `make paper` does the same runs, into `outputs/paper`; with other "
        'methods, seeds or budgets: `make paper ARGS="experiment=exact,squash seed=0,1 '
        'collector.total_frames=8000"`.\n'
        "- From the kept records: `make figures` redraws these pages."
    )


def _moment(moments: Sequence[Reached | None], values: Sequence[float]) -> str:
    """Return when the score was reached, or how many runs did where it was not all of them.

    Leaving out the slow ones would flatter.
    """
    if all(moments):
        return interquartile_mean(values).text(0)
    return f"{len(values)} of {len(moments)} runs"


def _count(counts: Sequence[int]) -> str:
    return interquartile_mean(counts).text(0)


def _outcomes(outcomes: Sequence[Outcome]) -> tuple[str, str]:
    if not outcomes:
        return "-", "-"
    returned: Interval = interquartile_mean([outcome.return_mean for outcome in outcomes])
    return returned.text(1), _count([sum(outcome.violations.values()) for outcome in outcomes])


def _all_of(values: Iterable[str]) -> str:
    return ", ".join(sorted(set(values)))
