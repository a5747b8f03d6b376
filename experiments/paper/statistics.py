"""What the records say: pure functions of them, with intervals over the seeds.

Intervals are percentile bootstrap intervals of the interquartile mean (Agarwal et al. 2021): the
seeds of each method are drawn again with replacement, methods apart from each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from experiments.paper.records import PROCESSOR, RETURN, VIOLATIONS, Record, Series

RESAMPLES, CONFIDENCE, BOOTSTRAP_SEED = 10_000, 0.95, 0
TRIMMED = 0.25
"""The share of runs left out at each end; below four runs none is."""
TARGET_SCORE = 0.75
EDGE = 0.1
"""The share of episodes that counts as training's start, and as its end."""

Floats = NDArray[np.float64]


class Interval(NamedTuple):
    """An interquartile mean over runs, or a difference of two.

    Args:
        value: The mean.
        low: The lower end of its bootstrap interval; the value itself for a single run.
        high: The upper end.
        runs: The number of runs, of the method with fewer.
    """

    value: float
    low: float
    high: float
    runs: int

    def text(self, digits: int = 2) -> str:
        """Return the mean and its interval in words."""
        if self.runs == 1:
            return f"{self.value:,.{digits}f} (one run)"
        if self.low == self.value == self.high:
            return f"{self.value:,.{digits if self.value else 0}f}"
        text = f"{self.value:,.{digits}f} [{self.low:,.{digits}f}, {self.high:,.{digits}f}]"
        return text.replace("-", "\N{MINUS SIGN}")


class Band(NamedTuple):
    """Interquartile means over training and their intervals' ends, each array ``(entries,)``."""

    steps: Floats
    value: Floats
    low: Floats
    high: Floats


class Reached(NamedTuple):
    """When a run first had a score: environment steps and processor seconds."""

    steps: float
    processor_seconds: float


def interquartile_mean(values: Sequence[float]) -> Interval:
    """Return the interquartile mean of runs and its interval.

    Raises:
        ValueError: for no values.
    """
    if not len(values):
        raise ValueError("values: expected those of one run or more, given none")
    data = np.asarray(values, dtype=np.float64)
    value = float(_trimmed(data))
    if len(data) == 1:
        return Interval(value, value, value, 1)
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
    if not series or any(curve.steps != series[0].steps for curve in series):
        raise ValueError("series: expected one or more, with entries at the same steps")
    data = np.array([curve.values for curve in series], dtype=np.float64)
    value = _trimmed(data, 0)
    low, high = (value, value) if len(data) == 1 else _bootstrap((data,), _trimmed, axis=0)
    return Band(np.array(series[0].steps, dtype=np.float64), value, low, high)


def score_curve(record: Record) -> Series:
    """Return the score of the episodes that ended since the entry before."""
    scale = record.config["env"]["score"]
    zero, one = scale["zero"], scale["one"]
    returns = record.curves[RETURN]
    values = tuple((value - zero) / (one - zero) for value in returns.values)
    return Series(steps=returns.steps, values=values)


def area_under_score(record: Record) -> float:
    """Return the mean score while training, each entry weighted by the steps since the last."""
    curve = score_curve(record)
    return float(np.average(curve.values, weights=np.diff(curve.steps, prepend=0)))


def reached(record: Record, score: float = TARGET_SCORE) -> Reached | None:
    """Return when a run's training score first was that high, or None if it never was."""
    curve, clock = score_curve(record), record.curves[PROCESSOR]
    for step, value in zip(curve.steps, curve.values, strict=True):
        if value >= score:
            seconds = np.interp(step, [0, *clock.steps], [0.0, *clock.values])
            return Reached(float(step), float(seconds))
    return None


def violation_rate(record: Record, constraint: str) -> Series:
    """Return violating steps per episode in each round of episodes, at the round's middle.

    All agents' episodes end together at a round's end. Batteries run low late in an episode, so a
    window that ends within episodes misleads; a run shorter than an episode is one window.
    """
    outcome = record.evaluation.stochastic
    length = outcome.steps / outcome.episodes
    together = length * record.config["env"]["agents"]
    whole = int(record.steps // together)
    edges = together * np.arange(1.0 + whole) if whole else np.array([0.0, record.steps])
    curve = record.curves[VIOLATIONS + constraint]
    counts = np.diff(np.interp(edges, [0, *curve.steps], [0.0, *curve.values]))
    middles = tuple(round(value) for value in ((edges[:-1] + edges[1:]) / 2).tolist())
    return Series(steps=middles, values=tuple((counts * length / np.diff(edges)).tolist()))


def violations_per_episode(record: Record) -> tuple[float, float]:
    """Return violating steps an episode in the first and in the last `EDGE` of training.

    Both are whole rounds of episodes, at least one; see `violation_rate`.
    """
    rates = np.sum([violation_rate(record, name).values for name in record.constraints], axis=0)
    window = max(1, round(EDGE * len(rates)))
    return float(rates[:window].mean()), float(rates[-window:].mean())


def start_and_end(runs: Sequence[Record]) -> tuple[Interval, Interval]:
    """Return the interquartile means of `violations_per_episode`, at the start and at the end."""
    start, end = zip(*map(violations_per_episode, runs), strict=True)
    return interquartile_mean(start), interquartile_mean(end)


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
