"""Verdicts follow the data: each rule, with records on either side of it."""

from collections.abc import Callable, Sequence

import pytest

from experiments.paper.claims import (
    QUASI,
    Claim,
    Evidence,
    Finding,
    Verdict,
    as_fast,
    at_least,
    beats_with_similar_violations,
    falls,
    faster,
    higher,
    on_par,
    satisfaction,
    score,
    violate_at_first,
)
from experiments.paper.records import PROCESSOR, RETURN, VIOLATIONS, Evaluation, Record, Series
from tests.paper.synthetic import (
    CONSTRAINTS,
    changed,
    make_evaluation,
    make_outcome,
    make_record,
)

YES, PARTLY, NO, UNTESTED = Verdict
STEPS, GRID = 20_000, tuple(range(500, 20_001, 500))


pytestmark = pytest.mark.usefixtures("coarse")


def judged(by: Callable[[], Finding]) -> Verdict:
    """Return the verdict of a claim that is judged so; `Verdict.UNTESTED` where it cannot be."""
    return Claim("", "", lambda evidence, flow: by()).judge(Evidence({}, {})).verdict


def scored(*scores: float) -> list[Record]:
    """Return runs with these scores."""
    return [
        changed(make_record(seed=seed), evaluation=make_evaluation(score))
        for seed, score in enumerate(scores)
    ]


def violating(training: int, evaluation: int) -> list[Record]:
    """Return a clean run, and one with violating steps, of 20,000 + 2 x 40,000 each."""
    broken = changed(make_outcome(), violations={"obstacle": evaluation, "battery": 0})
    run = changed(
        make_record(seed=1),
        training_violations={"obstacle": training, "battery": 0},
        evaluation=Evaluation(stochastic=make_outcome(), deterministic=broken),
    )
    return [make_record(seed=0), run]


def reaching(*steps: int | None) -> list[Record]:
    """Return runs whose training score jumps from 0 to 1 at these steps, or never does."""
    runs = []
    for seed, step in enumerate(steps):
        returns = [14.0 if step is not None and at >= step else -104.0 for at in GRID]
        time = Series(steps=GRID, values=tuple(at / 100 for at in GRID))
        curves = {RETURN: Series(steps=GRID, values=tuple(returns)), PROCESSOR: time}
        run = make_record(seed=seed)
        runs.append(changed(run, curves={**run.curves, **curves}))
    return runs


def falling(*rates: tuple[float, float]) -> list[Record]:
    """Return runs with violating steps per episode in the first and in the second half."""
    runs = []
    for seed, (first, second) in enumerate(rates):
        counts = [5 * (first * min(i, 20) + second * max(i - 20, 0)) for i in range(1, 41)]
        run = make_record(seed=seed)
        both = zip(CONSTRAINTS, (counts, [0.0] * len(GRID)), strict=True)
        curves = {VIOLATIONS + name: Series(steps=GRID, values=tuple(v)) for name, v in both}
        runs.append(changed(run, curves={**run.curves, **curves}))
    return runs


@pytest.mark.parametrize(
    ("runs", "perfect", "near"),
    [
        (violating(0, 0), YES, YES),
        (violating(1, 0), PARTLY, YES),
        (violating(0, 1), PARTLY, YES),
        (violating(60, 40), PARTLY, YES),
        (violating(60, 41), NO, PARTLY),
        (violating(600, 400), NO, PARTLY),
        (violating(600, 401), NO, NO),
    ],
)
def test_satisfaction(runs: list[Record], perfect: Verdict, near: Verdict) -> None:
    assert satisfaction(runs).verdict is perfect
    assert satisfaction(runs, QUASI, 10 * QUASI).verdict is near


LOW, MIDDLE, HIGH = (0.5, 0.51, 0.52), (0.7, 0.9, 1.1), (1.0, 1.01, 1.02)


@pytest.mark.parametrize(
    ("mine", "others", "is_higher", "is_at_least"),
    [
        (HIGH, [LOW], YES, YES),
        (HIGH, [LOW, LOW], YES, YES),
        (HIGH, [LOW, MIDDLE], PARTLY, YES),
        (HIGH, [MIDDLE], NO, YES),
        (HIGH, [HIGH], NO, YES),
        (MIDDLE, [HIGH, LOW], PARTLY, PARTLY),
        (LOW, [HIGH], NO, NO),
        (MIDDLE, [(0.1, 0.11), (2.0, 2.1)], NO, NO),
        (HIGH, [(0.5,)], UNTESTED, UNTESTED),
        (HIGH, [LOW, ()], UNTESTED, UNTESTED),
        ((), [LOW], UNTESTED, UNTESTED),
    ],
)
def test_comparison_with_others(
    mine: Sequence[float],
    others: list[Sequence[float]],
    is_higher: Verdict,
    is_at_least: Verdict,
) -> None:
    named: dict[str, Sequence[Record]] = {f"{i}": scored(*other) for i, other in enumerate(others)}
    assert judged(lambda: higher(scored(*mine), named, score)) is is_higher
    assert judged(lambda: at_least(scored(*mine), named, score)) is is_at_least


@pytest.mark.parametrize(
    ("mine", "other", "verdict"),
    [
        (HIGH, LOW, YES),
        (MIDDLE, HIGH, YES),
        ((0.95, 0.96, 0.95), HIGH, PARTLY),
        ((0.85, 0.86, 0.85), HIGH, NO),
        (HIGH, (), UNTESTED),
    ],
)
def test_on_par(mine: Sequence[float], other: Sequence[float], verdict: Verdict) -> None:
    assert judged(lambda: on_par(scored(*mine), scored(*other), score)) is verdict


@pytest.mark.parametrize(
    ("mine", "other", "as_fast_as", "faster_than"),
    [
        ((2000, 2500, 2000), (9000, 9500, 9000), YES, YES),
        ((2000, 2500, 2000), (None, None, 9000), YES, YES),
        ((2000, 2500, 3000), (2500, 2000, 3000), YES, NO),
        ((5000, 5000, 5500), (4000, 4000, 4500), PARTLY, NO),
        ((9000, 9000, 9500), (4000, 4000, 4500), NO, NO),
        ((2000, 2500, None), (9000, 9500, 9000), NO, NO),
        ((None, None), (None, None), NO, NO),
        ((2000, 2500), (), UNTESTED, UNTESTED),
    ],
)
def test_speed(
    mine: Sequence[int | None],
    other: Sequence[int | None],
    as_fast_as: Verdict,
    faster_than: Verdict,
) -> None:
    assert judged(lambda: as_fast(reaching(*mine), reaching(*other))) is as_fast_as
    assert judged(lambda: faster(reaching(*mine), {"other": reaching(*other)})) is faster_than


@pytest.mark.parametrize(
    ("methods", "verdict"),
    [
        ([[(20, 2), (20, 2)]], YES),
        ([[(20, 0)]], YES),
        ([[(20, 2.1), (20, 2.1)]], PARTLY),
        ([[(20, 1)], [(20, 10)]], PARTLY),
        ([[(20, 1)], [(20, 11)]], NO),
        ([[(1, 5)]], NO),
        ([[(0, 0)]], NO),
    ],
)
def test_fall_of_violations(methods: list[list[tuple[float, float]]], verdict: Verdict) -> None:
    assert falls({f"{i}": falling(*method) for i, method in enumerate(methods)}).verdict is verdict


@pytest.mark.parametrize(
    ("rates", "verdict"),
    [([(1, 0), (5, 0)], YES), ([(0.9, 0), (5, 0)], PARTLY), ([(0.9, 9)], NO)],
)
def test_violations_at_first(rates: list[tuple[float, float]], verdict: Verdict) -> None:
    assert violate_at_first({"method": falling(*rates)}).verdict is verdict


@pytest.mark.parametrize(
    ("mine", "end", "verdict"),
    [(HIGH, 2, YES), (HIGH, 9, PARTLY), (LOW, 2, NO), ((), 2, UNTESTED)],
)
def test_a_higher_score_with_similar_violations(
    mine: Sequence[float], end: float, verdict: Verdict
) -> None:
    def with_end(runs: list[Record], *ends: float) -> list[Record]:
        curves = falling(*((20, end) for end in ends))
        return [changed(run, curves=drawn.curves) for run, drawn in zip(runs, curves, strict=True)]

    other = with_end(scored(0.6, 0.61, 0.62), 1, 2, 3)
    runs = with_end(scored(*mine), *(end + i for i in range(len(mine))))
    found = judged(lambda: beats_with_similar_violations(runs, other, "other"))
    assert found is verdict


def test_methods_without_runs_are_named() -> None:
    evidence = Evidence({"exact": scored(1.0)}, {})
    claim = Claim("", "", lambda e, flow: higher(e.one(flow), e.of("penalty"), score))
    assert claim.judge(evidence) == Finding(UNTESTED, "no runs of reward penalty")
    assert claim.judge(evidence, "squash").verdict is UNTESTED


def test_numbers_are_said() -> None:
    found = satisfaction(violating(3, 4))
    assert found.measured.startswith("7 violating of 200,000 steps in 2 runs")
    found = at_least(scored(*HIGH), {"low": scored(*LOW)}, score)
    assert found.measured.startswith("0.50 [")
    assert found.measured.endswith("over low")
    found = faster(reaching(2000, 2500), {"slow": reaching(None, 9000)})
    assert "1 of slow never did" in found.measured
