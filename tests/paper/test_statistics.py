import itertools

import numpy as np
import pytest

from experiments.paper.records import Record, Series
from experiments.paper.statistics import (
    Interval,
    area_under_score,
    band,
    difference,
    interquartile_mean,
    reached,
    score_curve,
    violation_rate,
    violations_per_episode,
)
from tests.paper.synthetic import CONSTRAINTS, changed, make_record


def with_curves(record: Record, **curves: tuple[list[int], list[float]]) -> Record:
    """Return the record with curves given as ``train_return=(steps, values)``."""
    new = {
        name.replace("_", "/", 1): Series(steps=tuple(steps), values=tuple(values))
        for name, (steps, values) in curves.items()
    }
    return changed(record, curves={**record.curves, **new})


@pytest.mark.parametrize(
    ("values", "mean"),
    [
        ([3.0], 3.0),
        ([1.0, 2.0, 6.0], 3.0),  # nothing is trimmed below four
        ([0.0, 1.0, 3.0, 100.0], 2.0),
        ([0.0, 1.0, 2.0, 6.0, 100.0], 3.0),
        ([-50.0, -40.0, 1.0, 2.0, 3.0, 4.0, 80.0, 90.0], 2.5),
    ],
)
def test_interquartile_mean(values: list[float], mean: float) -> None:
    for order in itertools.islice(itertools.permutations(values), 10):
        assert interquartile_mean(order).value == pytest.approx(mean)


def test_the_interval_agrees_with_all_resamples() -> None:
    # Three runs have only 27 resamples: their exact 2.5 % and 97.5 % quantiles are the reference.
    values = [1.0, 2.0, 6.0]
    means = [np.mean(draw) for draw in itertools.product(values, repeat=3)]
    interval = interquartile_mean(values)
    assert (interval.low, interval.high) == (min(means), max(means))
    assert interval == interquartile_mean(values)


def test_runs_that_agree_have_an_interval_without_width() -> None:
    interval = interquartile_mean([0.0] * 5)
    assert (interval.value, interval.low, interval.high, interval.runs) == (0, 0, 0, 5)


def test_one_run_has_no_interval() -> None:
    interval = interquartile_mean([2.0])
    assert interval == (2.0, 2.0, 2.0, 1)
    assert interval.text() == "2.00 (one run)"


def test_no_runs_are_refused() -> None:
    with pytest.raises(ValueError, match="given none"):
        interquartile_mean([])


def test_a_difference_draws_both_methods_apart() -> None:
    interval = difference([1.0, 3.0], [10.0, 10.0])
    assert (interval.value, interval.low, interval.high) == (-8.0, -9.0, -7.0)
    # Paired draws of equal runs would have no width.
    equal = difference([1.0, 3.0], [1.0, 3.0])
    assert (equal.value, equal.low, equal.high) == (0.0, -2.0, 2.0)
    with pytest.raises(ValueError, match="given 1 and 2"):
        difference([1.0], [1.0, 2.0])


def test_a_band_is_the_interval_at_each_entry() -> None:
    runs = [Series(steps=(10, 20), values=(float(i), float(i * i))) for i in range(5)]
    result = band(runs)
    assert result.steps.tolist() == [10, 20]
    for entry, values in enumerate([[0, 1, 2, 3, 4], [0, 1, 4, 9, 16]]):
        interval = interquartile_mean(values)
        assert result.value[entry] == interval.value
        assert result.low[entry] == pytest.approx(interval.low, abs=0.35)
        assert result.high[entry] == pytest.approx(interval.high, abs=0.35)


def test_a_band_needs_one_grid() -> None:
    with pytest.raises(ValueError, match="entries at the same steps"):
        band([Series(steps=(10,), values=(0.0,)), Series(steps=(11,), values=(0.0,))])
    with pytest.raises(ValueError, match="expected one or more"):
        band([])


def test_score_and_area() -> None:
    # Scores 0 for 100 steps, 1 for 100 and 0.5 for 200: (0 + 100 + 100) / 400.
    record = with_curves(make_record(), train_return=([100, 200, 400], [-104.0, 14.0, -45.0]))
    assert score_curve(record).values == pytest.approx((0.0, 1.0, 0.5))
    assert area_under_score(record) == pytest.approx(0.5)


def test_the_moment_of_a_score() -> None:
    record = with_curves(
        make_record(),
        train_return=([100, 200, 400], [-104.0, 14.0, -45.0]),
        train_processor_seconds=([100, 300], [4.0, 8.0]),
    )
    assert reached(record, 0.75) == (200, 6.0)
    first = reached(record, 0.0)
    assert first is not None
    assert first.steps == 100
    assert reached(record, 1.1) is None


def test_violations_at_start_and_end() -> None:
    # 16 agents with episodes of 100 steps end together every 1,600 steps; ten percent of twelve
    # such rounds is one. What happens after the twelfth, at 19,200, is of unfinished episodes.
    steps = [800, 1600, 3200, 17_600, 18_400, 19_200, 20_000]
    record = with_curves(
        make_record(),
        violations_obstacle=(steps, [10.0, 32.0, 40.0, 50.0, 50.0, 54.0, 90.0]),
        violations_battery=(steps, [0.0, 16.0, 99.0, 99.0, 99.0, 103.0, 103.0]),
    )
    assert violation_rate(record, "obstacle").steps == tuple(800 + 1600 * i for i in range(12))
    start, end = violations_per_episode(record)
    assert start == pytest.approx((32 + 16) / 16)
    assert end == pytest.approx((4 + 4) / 16)


def test_a_run_shorter_than_an_episode_is_one_window() -> None:
    record = with_curves(
        make_record(steps=800),
        violations_obstacle=([400, 800], [4.0, 12.0]),
        violations_battery=([400, 800], [0.0, 4.0]),
    )
    assert violation_rate(record, "obstacle").steps == (400,)
    assert violations_per_episode(record) == pytest.approx((2.0, 2.0))


def test_violations_per_episode_add_up() -> None:
    record = make_record("penalty", rate=0.1)
    rates = violation_rate(record, CONSTRAINTS[0])
    curve = record.curves[f"violations/{CONSTRAINTS[0]}"]
    # Twelve whole rounds of 16 episodes.
    total = np.interp(19_200, curve.steps, curve.values)
    assert len(rates.values) == 12
    assert sum(rates.values) * 16 == pytest.approx(total)


def test_intervals_in_words() -> None:
    assert Interval(-0.5, -1000.25, 0.0, 3).text() == "−0.50 [−1,000.25, 0.00]"
    assert Interval(2000.4, 1.0, 3.0, 3).text(0) == "2,000 [1, 3]"
    assert Interval(0.0, 0.0, 0.0, 3).text() == "0"
    assert Interval(1.5, 1.5, 1.5, 3).text() == "1.50"
