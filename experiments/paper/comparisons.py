"""Rules that compare a flow with other methods: pure functions of records."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from experiments.paper.records import Record
from experiments.paper.statistics import Interval, difference, interquartile_mean, reached
from experiments.paper.verdicts import Finding, Verdict, counted_runs, interval, untested

Value = Callable[[Record], float]

PAR, SLOWER = 0.9, 1.5
"""A score of this share is nearly on par; this many times the steps are nearly as fast."""


def higher(
    runs: Sequence[Record], others: dict[str, Sequence[Record]], value: Value, digits: int = 2
) -> Finding:
    """Judge whether a value is higher than each other method's.

    Yes if every interval of the difference lies above 0; no if one lies below 0, or all hold 0;
    else partly.
    """
    if lacking := _lacking(runs, others):
        return lacking
    differences = _differences(runs, others, value)
    if all(_low(each) > 0 for each in differences.values()):
        verdict = Verdict.YES
    elif any(_high(each) < 0 for each in differences.values()):
        verdict = Verdict.NO
    else:
        some = any(_low(each) > 0 for each in differences.values())
        verdict = Verdict.PARTLY if some else Verdict.NO
    return Finding(verdict, _said(differences, digits))


def at_least(
    runs: Sequence[Record], others: dict[str, Sequence[Record]], value: Value, digits: int = 2
) -> Finding:
    """Judge whether a value is at least each other method's.

    Yes if no interquartile mean is higher; partly if each difference to a higher one has 0 in its
    interval; else no.
    """
    if lacking := _lacking(runs, others):
        return lacking
    differences = _differences(runs, others, value)
    if all(each.value >= 0 for each in differences.values()):
        verdict = Verdict.YES
    elif all(_high(each) >= 0 for each in differences.values()):
        verdict = Verdict.PARTLY
    else:
        verdict = Verdict.NO
    return Finding(verdict, _said(differences, digits))


def on_par(runs: Sequence[Record], other: Sequence[Record], value: Value) -> Finding:
    """Judge whether a value comes up to another method's.

    Yes unless the interval of the difference lies below 0; then partly from `PAR` times the other's
    on; else no.
    """
    if lacking := _lacking(runs, {"the other": other}):
        return lacking
    mine, theirs = (interquartile_mean([value(run) for run in each]) for each in (runs, other))
    apart = difference([value(run) for run in runs], [value(run) for run in other])
    if _high(apart) >= 0:
        verdict = Verdict.YES
    else:
        verdict = Verdict.PARTLY if mine.value >= PAR * theirs.value else Verdict.NO
    measured = f"{interval(mine)} against {interval(theirs)}; difference {interval(apart)}"
    return Finding(verdict, measured)


def as_fast(runs: Sequence[Record], other: Sequence[Record]) -> Finding:
    """Judge whether the target score is reached in as few steps as by another method.

    Yes unless the interval of the difference lies above 0; then partly up to `SLOWER` times the
    other's steps; else no, and always no if one run never reached it.
    """
    if lacking := _lacking(runs, {"the other": other}):
        return lacking
    if never := sum(reached(run) is None for run in runs):
        return Finding(Verdict.NO, f"{never} of {counted_runs(len(runs))} never reached the score")
    mine, theirs = [steps_to_score(run) for run in runs], [steps_to_score(run) for run in other]
    apart, one, two = difference(mine, theirs), interquartile_mean(mine), interquartile_mean(theirs)
    if _low(apart) <= 0:
        verdict = Verdict.YES
    else:
        verdict = Verdict.PARTLY if one.value <= SLOWER * two.value else Verdict.NO
    measured = f"{interval(one, 0)} steps against {interval(two, 0)}"
    return Finding(verdict, measured)


def faster(runs: Sequence[Record], others: dict[str, Sequence[Record]]) -> Finding:
    """Judge whether the target score is reached in fewer steps than by each other method.

    As `higher`, with steps saved. A run that never reached the score counts with its whole budget,
    which is less than it would have needed.
    """
    finding = higher(runs, others, lambda run: -steps_to_score(run), 0)
    if finding.verdict is Verdict.UNTESTED:
        return finding
    never = {
        name: sum(reached(run) is None for run in each)
        for name, each in {"this flow": runs, **others}.items()
    }
    said = [f"{count} of {name} never did" for name, count in never.items() if count]
    measured = "; ".join(["steps saved: " + finding.measured, *said])
    return Finding(Verdict.NO if never["this flow"] else finding.verdict, measured)


def steps_to_score(run: Record) -> float:
    """Return the steps to the target score; the whole budget if it was never reached."""
    moment = reached(run)
    return float(run.steps if moment is None else moment.steps)


def _differences(
    runs: Sequence[Record], others: dict[str, Sequence[Record]], value: Value
) -> dict[str, Interval]:
    mine = [value(run) for run in runs]
    return {name: difference(mine, [value(run) for run in each]) for name, each in others.items()}


def _said(differences: dict[str, Interval], digits: int) -> str:
    return "; ".join(f"{interval(each, digits)} over {name}" for name, each in differences.items())


def _lacking(runs: Sequence[Record], others: dict[str, Sequence[Record]]) -> Finding | None:
    """Return why no interval can be had, if so."""
    counts = {"this flow": len(runs), **{name: len(each) for name, each in others.items()}}
    if len(counts) > 1 and min(counts.values()) >= 2:
        return None
    few = [f"{count} of {name}" for name, count in counts.items() if count < 2]
    return untested("needs two runs or more of each, given " + (", ".join(few) or "no others"))


def _low(each: Interval) -> float:
    assert each.low is not None
    return each.low


def _high(each: Interval) -> float:
    assert each.high is not None
    return each.high
