"""Verdicts, and the rules for violations: pure functions of records, none is written by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from experiments.paper.records import Record
from experiments.paper.statistics import Interval, interquartile_mean, violations_per_episode

QUASI = 1e-3
"""Up to this share of violating steps a run is called quasi-perfect."""
FALL, SOME_FALL = 10.0, 2.0
"""By how much violations per episode fall at least: drastically, and at all."""


class Verdict(Enum):
    """What the data say of a claim."""

    YES = "reproduced"
    PARTLY = "partly"
    NO = "not reproduced"
    UNTESTED = "not tested"


@dataclass(frozen=True)
class Finding:
    """A verdict and the numbers that it rests on, in words."""

    verdict: Verdict
    measured: str


def satisfaction(runs: Sequence[Record]) -> Finding:
    """Judge whether constraints hold from the first step of training to the last evaluation.

    Yes without a single violating step in any run; partly while no run has a share above `QUASI`.
    """
    worst, measured = _violating_share(runs)
    return Finding(_up_to(worst, 0.0, QUASI), measured)


def near_satisfaction(runs: Sequence[Record]) -> Finding:
    """Judge whether constraints nearly always hold from the first step to the last.

    Yes while no run has a share of violating steps above `QUASI`; partly up to ten times that.
    """
    worst, measured = _violating_share(runs)
    return Finding(_up_to(worst, QUASI, 10 * QUASI), measured)


def falls(methods: dict[str, Sequence[Record]], factor: float = FALL) -> Finding:
    """Judge whether violations per episode fall from the start of training to its end.

    Yes if every method's fall to 1 / `factor` or less; partly if every method's fall to 1 /
    `SOME_FALL`; else no.
    """
    if not methods or not all(methods.values()):
        return untested(_missing(methods))
    ratios, said = [], []
    for name, runs in methods.items():
        start, end = _start_and_end(runs)
        ratio = start.value / end.value if end.value else float("inf") if start.value else 1.0
        ratios.append(ratio)
        times = "to 0" if ratio == float("inf") else f"{ratio:.1f} times"
        said.append(f"{name}: {interval(start)} to {interval(end)}, {times}")
    if min(ratios) >= factor:
        verdict = Verdict.YES
    else:
        verdict = Verdict.PARTLY if min(ratios) >= SOME_FALL else Verdict.NO
    return Finding(verdict, "; ".join(said))


def violate_at_first(methods: dict[str, Sequence[Record]]) -> Finding:
    """Judge whether methods violate constraints while they learn.

    Yes with one violating step an episode or more, at the start, in every run; no if no run has
    that; else partly.
    """
    if not methods or not all(methods.values()):
        return untested(_missing(methods))
    starts = [violations_per_episode(run)[0] >= 1 for runs in methods.values() for run in runs]
    said = [f"{name}: {interval(_start_and_end(runs)[0])}" for name, runs in methods.items()]
    some = Verdict.PARTLY if any(starts) else Verdict.NO
    return Finding(Verdict.YES if all(starts) else some, "; ".join(said))


def untested(reason: str) -> Finding:
    """Return that the data cannot tell."""
    return Finding(Verdict.UNTESTED, reason)


def interval(each: Interval, digits: int = 2) -> str:
    """Write an interquartile mean and its interval."""
    if each.low is None or each.high is None:
        return f"{each.value:,.{digits}f} (one run)"
    if each.low == each.value == each.high:
        return f"{each.value:,.{digits if each.value else 0}f}"
    text = f"{each.value:,.{digits}f} [{each.low:,.{digits}f}, {each.high:,.{digits}f}]"
    return text.replace("-", "\N{MINUS SIGN}")


def _violating_share(runs: Sequence[Record]) -> tuple[float | None, str]:
    """Return the largest share of violating steps of any run, and the counts in words."""
    if not runs:
        return None, "no runs"
    counts = [sum(run.violations.values()) for run in runs]
    steps = [run.steps + sum(each.steps for each in run.evaluation.values()) for run in runs]
    worst = max(count / taken for count, taken in zip(counts, steps, strict=True))
    measured = f"{sum(counts):,} violating of {sum(steps):,} steps in {counted_runs(len(runs))}"
    return worst, measured + (f", in the worst run {100 * worst:.2g} %" if worst else "")


def _up_to(value: float | None, yes: float, partly: float) -> Verdict:
    if value is None:
        return Verdict.UNTESTED
    if value <= yes:
        return Verdict.YES
    return Verdict.PARTLY if value <= partly else Verdict.NO


def _start_and_end(runs: Sequence[Record]) -> tuple[Interval, Interval]:
    start, end = zip(*(violations_per_episode(run) for run in runs), strict=True)
    return interquartile_mean(start), interquartile_mean(end)


def _missing(methods: dict[str, Sequence[Record]]) -> str:
    return "no runs of " + (", ".join(name for name, runs in methods.items() if not runs) or "any")


def counted_runs(count: int) -> str:
    """Write a number of runs."""
    return f"{count} run" if count == 1 else f"{count} runs"
