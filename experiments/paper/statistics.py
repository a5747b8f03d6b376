"""What the records say: pure functions of them, with intervals over the seeds.

Intervals are percentile bootstrap intervals of the interquartile mean (Agarwal et al. 2021): the
seeds of each method are drawn again with replacement, methods apart from each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from experiments.paper.records import MODES, PROCESSOR, RETURN, SECONDS, VIOLATIONS, Record, Series

RESAMPLES, CONFIDENCE, BOOTSTRAP_SEED = 10_000, 0.95, 0
TRIMMED = 0.25
"""The share of runs left out at each end; below four runs none is."""
TARGET_SCORE = 0.75
EDGE = 0.1
"""The share of episodes that counts as training's start, and as its end."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Interval:
    """An interquartile mean over runs.

    Args:
        value: the mean.
        low: lower end of its bootstrap interval, ``None`` for a single run.
        high: upper end.
        runs: how many.
    """

    value: float
    low: float | None
    high: float | None
    runs: int


@dataclass(frozen=True)
class Band:
    """Interquartile means over training, each array ``(entries,)``; see `Interval`."""

    steps: Floats
    value: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True)
class Reached:
    """When a run first had a score: environment steps, wall seconds, processor seconds."""

    steps: int
    seconds: float
    processor_seconds: float


@dataclass(frozen=True)
class Summary:
    """A method in numbers.

    Args:
        method: its name.
        seeds: of its runs.
        score: of the final evaluation, by mode.
        area: see `area_under_score`.
        reached: how many runs came to `TARGET_SCORE`.
        steps_to_score: of these runs to that score; ``None`` unless every run came there, because
            leaving out the slow ones would flatter.
        seconds_to_score: the same in wall seconds.
        processor_seconds_to_score: the same in processor seconds.
        violations: per run in training and evaluations together, by constraint.
        violations_per_episode: see `violations_per_episode`, at the start and at the end.
    """

    method: str
    seeds: tuple[int, ...]
    score: dict[str, Interval]
    area: Interval
    reached: int
    steps_to_score: Interval | None
    seconds_to_score: Interval | None
    processor_seconds_to_score: Interval | None
    violations: dict[str, Interval]
    violations_per_episode: tuple[Interval, Interval]


def interquartile_mean(values: Sequence[float]) -> Interval:
    """Return the interquartile mean of runs and its interval.

    Raises:
        ValueError: for no values.
    """
    data = np.asarray(values, dtype=np.float64)
    if not len(data):
        raise ValueError("values: expected those of one run or more, given none")
    value = float(_trimmed(data))
    if len(data) == 1:
        return Interval(value, None, None, 1)
    low, high = _bootstrap((data,), _trimmed)
    return Interval(value, float(low), float(high), len(data))


def difference(first: Sequence[float], second: Sequence[float]) -> Interval:
    """Return the interquartile mean of the first method's runs less that of the second's.

    Raises:
        ValueError: when one of them has less than two runs.
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if min(len(a), len(b)) < 2:
        raise ValueError(f"expected two runs or more of each, given {len(a)} and {len(b)}")

    def less(x: Floats, y: Floats, axis: int = -1) -> Floats:
        return _trimmed(x, axis) - _trimmed(y, axis)

    low, high = _bootstrap((a, b), less)
    return Interval(float(less(a, b)), float(low), float(high), min(len(a), len(b)))


def band(series: Sequence[Series]) -> Band:
    """Return the interquartile mean at each entry, over runs with entries at the same steps.

    Raises:
        ValueError: for no runs, and for runs with entries at other steps than the first's.
    """
    if not series or any(each.steps != series[0].steps for each in series):
        raise ValueError("series: expected one or more, with entries at the same steps")
    data = np.array([each.values for each in series], dtype=np.float64)
    value = _trimmed(data, 0)
    low, high = (value, value) if len(data) == 1 else _bootstrap((data,), _trimmed, axis=0)
    return Band(np.array(series[0].steps, dtype=np.float64), value, low, high)


def score_curve(record: Record) -> Series:
    """Return the score of the episodes that ended since the entry before."""
    scale = record.config["env"]["score"]
    zero, one = scale["zero"], scale["one"]
    returns = record.curves[RETURN]
    return Series(returns.steps, tuple((value - zero) / (one - zero) for value in returns.values))


def area_under_score(record: Record) -> float:
    """Return the mean score while training, each entry weighted by the steps since the last."""
    curve = score_curve(record)
    weights = np.diff(curve.steps, prepend=0)
    return float(np.average(curve.values, weights=weights))


def reached(record: Record, score: float = TARGET_SCORE) -> Reached | None:
    """Return when a run's training score first was that high, or ``None`` if it never was."""
    curve = score_curve(record)
    for step, value in zip(curve.steps, curve.values, strict=True):
        if value >= score:
            seconds, processor = (
                float(np.interp(step, [0, *series.steps], [0.0, *series.values]))
                for series in (record.curves[SECONDS], record.curves[PROCESSOR])
            )
            return Reached(step, seconds, processor)
    return None


def violation_curve(record: Record) -> Series:
    """Return the violating steps since the start, all constraints together."""
    curves = [record.curves[VIOLATIONS + name] for name in record.constraints]
    values = np.sum([curve.values for curve in curves], axis=0)
    return Series(curves[0].steps, tuple(values.tolist()))


def round_ends(record: Record) -> list[float]:
    """Return the steps at which all agents' episodes end together, or the run's end if none do.

    Batteries run low late in an episode, so a window that ends within episodes misleads.
    """
    evaluation = record.evaluation[MODES[0]]
    length = evaluation.steps / evaluation.episodes * record.config["env"]["agents"]
    return [length * i for i in range(1, int(record.steps // length) + 1)] or [float(record.steps)]


def violations_per_episode(record: Record) -> tuple[float, float]:
    """Return violating steps an episode in the first and in the last `EDGE` of training.

    Both are whole rounds of episodes, at least one; see `round_ends`.
    """
    ends = [0.0, *round_ends(record)]
    window = max(1, round(EDGE * (len(ends) - 1)))
    curve = violation_curve(record)
    counts = np.interp(ends, [0, *curve.steps], [0.0, *curve.values])
    evaluation = record.evaluation[MODES[0]]
    episodes = ends[window] * evaluation.episodes / evaluation.steps
    return float(counts[window] / episodes), float((counts[-1] - counts[-1 - window]) / episodes)


def total_violations(record: Record) -> int:
    """Return the violating steps of training and both evaluations, all constraints together."""
    return sum(record.violations.values())


def by_method(records: Sequence[Record]) -> dict[str, list[Record]]:
    """Return the records of each method, in the order in which methods first appear."""
    grouped: dict[str, list[Record]] = {}
    for record in records:
        grouped.setdefault(record.method, []).append(record)
    return grouped


def summarise(runs: Sequence[Record]) -> Summary:
    """Return one method in numbers.

    Raises:
        ValueError: for no runs, and for runs of several methods.
    """
    if len({run.method for run in runs}) != 1:
        raise ValueError(
            f"runs: expected those of one method, given {sorted({run.method for run in runs})}"
        )
    moments = [moment for run in runs if (moment := reached(run)) is not None]
    whole = len(moments) == len(runs)
    start, end = zip(*(violations_per_episode(run) for run in runs), strict=True)
    return Summary(
        method=runs[0].method,
        seeds=tuple(run.seed for run in runs),
        score={
            mode: interquartile_mean([run.evaluation[mode].score for run in runs]) for mode in MODES
        },
        area=interquartile_mean([area_under_score(run) for run in runs]),
        reached=len(moments),
        steps_to_score=interquartile_mean([m.steps for m in moments]) if whole else None,
        seconds_to_score=interquartile_mean([m.seconds for m in moments]) if whole else None,
        processor_seconds_to_score=(
            interquartile_mean([m.processor_seconds for m in moments]) if whole else None
        ),
        violations={
            name: interquartile_mean([run.violations[name] for run in runs])
            for name in runs[0].constraints
        },
        violations_per_episode=(interquartile_mean(start), interquartile_mean(end)),
    )


def _trimmed(values: Floats, axis: int = -1) -> Floats:
    return np.asarray(stats.trim_mean(values, TRIMMED, axis=axis), dtype=np.float64)


def _bootstrap(
    samples: tuple[Floats, ...], statistic: Any, *, axis: int = -1
) -> tuple[Floats, Floats]:
    result = stats.bootstrap(
        samples,
        statistic,
        axis=axis,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(BOOTSTRAP_SEED),
        vectorized=True,
        batch=500,
    )
    return result.confidence_interval.low, result.confidence_interval.high
