"""The paper's claims and this project's aims, each with the rule that judges it.

Rules are pure functions of the evidence: no verdict is written by hand.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

from cnfp_torchrl.geometry import Ball, Box
from experiments.paper.intersections import Tried, incompatible, intersecting
from experiments.paper.labels import label
from experiments.paper.records import HostileRun, Record
from experiments.paper.statistics import (
    TARGET_SCORE,
    Interval,
    area_under_score,
    difference,
    interquartile_mean,
    reached,
    start_and_end,
    violations_per_episode,
)

Runs = Sequence[Record]
Value = Callable[[Record], float]

QUASI = 1e-3
"""Up to this share of violating steps a run is called quasi-perfect."""
FALL, SOME_FALL = 10.0, 2.0
"""How many times violations per episode fall at least: drastically, and at all."""
PAR, SLOWER = 0.9, 1.5
"""A score of this share is nearly on par; this many times the steps are nearly as fast."""

FLOWS = ("squash", "exact")
"""The paper's own chain and the exact flow, of which each claim about the flow is judged."""
PENALIZED = ("penalty", "lagrangian")
BASELINES = ("squash", "projection", *PENALIZED)
"""Constrained baselines that there must be runs of."""


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


class Untested(Exception):
    """The data cannot tell; the argument says why."""


@dataclass(frozen=True)
class Evidence:
    """All that claims are judged by.

    Args:
        runs: The records of each method.
        hostile: What hostile networks did behind each flow, empty where that is not kept.
    """

    runs: Mapping[str, Runs]
    hostile: Mapping[str, Sequence[HostileRun]]

    def of(self, *methods: str) -> dict[str, Runs]:
        """Return the records of some methods by their names for readers.

        Raises:
            Untested: for a method without any.
        """
        if lacking := [label(method).name for method in methods if not self.runs.get(method)]:
            raise Untested("no runs of " + ", ".join(lacking))
        return {label(method).name: self.runs[method] for method in methods}

    def one(self, method: str) -> Runs:
        """Return the records of a method; raises `Untested` as `of` does."""
        (runs,) = self.of(method).values()
        return runs

    def baselines(self) -> dict[str, Runs]:
        """Return the records of every constrained baseline, there or required; see `of`."""
        there = [run for run in self.runs if label(run).baseline]
        return self.of(*dict.fromkeys((*BASELINES, *there)))


@dataclass(frozen=True)
class Claim:
    """A claim about methods.

    Args:
        statement: What is claimed.
        rule: When which verdict falls, in words.
        by: What judges it, by the evidence and for the method of one flow.
    """

    statement: str
    rule: str
    by: Callable[[Evidence, str], Finding]

    def judge(self, evidence: Evidence, flow: str = "exact") -> Finding:
        """Return what the evidence says of the claim."""
        try:
            return self.by(evidence, flow)
        except Untested as reason:
            return Finding(Verdict.UNTESTED, str(reason))


# Violations.


def satisfaction(runs: Runs, yes: float = 0.0, partly: float = QUASI) -> Finding:
    """Judge the largest share of violating steps of any run, evaluations included."""
    counts = [run.violations for run in runs]
    steps = [
        run.steps + sum(evaluation.steps for evaluation in run.evaluation.both) for run in runs
    ]
    worst = max(count / taken for count, taken in zip(counts, steps, strict=True))
    number = "1 run" if len(runs) == 1 else f"{len(runs)} runs"
    measured = f"{sum(counts):,} violating of {sum(steps):,} steps in {number}"
    measured += f", in the worst run {100 * worst:.2g} %" if worst else ""
    return Finding(_up_to(worst, yes, partly), measured)


def violate_at_first(methods: Mapping[str, Runs]) -> Finding:
    """Judge in which runs there is a violating step an episode or more at the start."""
    early = [violations_per_episode(run)[0] >= 1 for runs in methods.values() for run in runs]
    said = [f"{name}: {start_and_end(runs)[0].text()}" for name, runs in methods.items()]
    return Finding(_graded(all(early), any(early)), "; ".join(said))


def falls(methods: Mapping[str, Runs]) -> Finding:
    """Judge how many times violations per episode fall, start to end, for the least of methods."""
    ratios, said = [], []
    for name, runs in methods.items():
        start, end = start_and_end(runs)
        ratio = start.value / end.value if end.value else float("inf") if start.value else 1.0
        ratios.append(ratio)
        times = "to 0" if ratio == float("inf") else f"{ratio:.1f} times"
        said.append(f"{name}: {start.text()} to {end.text()}, {times}")
    return Finding(_graded(min(ratios) >= FALL, min(ratios) >= SOME_FALL), "; ".join(said))


def samples_outside(tried: Tried, where: str, flow: str) -> Finding:
    """Judge that no sample of random cases lies outside the sets that are judged."""
    share = f"{100 * tried.outside[flow]:.1f} % of the samples outside"
    cases = where.format(broken=tried.broken[flow], cases=tried.cases)
    return Finding(_graded(not tried.broken[flow]), f"{share}{cases}")


def never_violated(steps: Sequence[tuple[Mapping[str, int], int]], what: str = "") -> Finding:
    """Judge that none of some steps violates: violations by constraint, and number of steps."""
    if not steps:
        raise Untested("nothing was counted")
    broken = sum(sum(violations.values()) for violations, _ in steps)
    measured = f"{broken:,} violating of {sum(taken for _, taken in steps):,} steps{what}"
    return Finding(_graded(not broken), measured)


def hostile(evidence: Evidence, flow: str) -> Finding:
    """Judge that hostile networks behind a flow violate nothing."""
    runs = evidence.hostile.get(flow, [])
    return never_violated([(r.violations, r.steps) for r in runs], f", {len(runs)} networks")


def afterwards(runs: Runs) -> Finding:
    """Judge that no constraint that was switched on after training is violated."""
    evaluations = [evaluation for run in runs for evaluation in run.afterwards.values()]
    return never_violated(
        [(o.violations, o.steps) for evaluation in evaluations for o in evaluation.both]
    )


# Comparisons.


def score(run: Record) -> float:
    """Return the score of the stochastic policy after training."""
    return run.evaluation.stochastic.score


def steps_to_score(run: Record) -> float:
    """Return the steps to the target score; the whole budget if it was never reached."""
    moment = reached(run)
    return float(run.steps) if moment is None else moment.steps


def higher(runs: Runs, others: Mapping[str, Runs], value: Value, digits: int = 2) -> Finding:
    """Judge whether every interval of the difference to others lies above 0, or some, or none."""
    apart = _differences(runs, others, value)
    above = [result.low > 0 for result in apart.values()]
    below = any(result.high < 0 for result in apart.values())
    return Finding(_graded(all(above), any(above) and not below), _said(apart, digits))


def at_least(runs: Runs, others: Mapping[str, Runs], value: Value) -> Finding:
    """Judge whether no other mean is higher, or none by more than its interval."""
    apart = _differences(runs, others, value)
    means = all(result.value >= 0 for result in apart.values())
    return Finding(_graded(means, all(result.high >= 0 for result in apart.values())), _said(apart))


def faster(runs: Runs, others: Mapping[str, Runs]) -> Finding:
    """Judge as `higher` does, by steps saved to the score; none are where it never came there."""
    found = higher(runs, others, lambda run: -steps_to_score(run), 0)
    never = {n: sum(reached(run) is None for run in r) for n, r in others.items()}
    said = [f"{count} of {name} never did" for name, count in never.items() if count]
    came = all(reached(run) for run in runs)
    measured = "; ".join(["steps saved: " + found.measured, *said])
    return Finding(found.verdict if came else Verdict.NO, measured)


def on_par(runs: Runs, other: Runs, value: Value) -> Finding:
    """Judge whether a value comes up to another method's, or nearly."""
    apart, mine, theirs = _beside(runs, other, value)
    near = mine.value >= PAR * theirs.value
    measured = f"{mine.text()} against {theirs.text()}; difference {apart.text()}"
    return Finding(_graded(apart.high >= 0, near), measured)


def as_fast(runs: Runs, other: Runs) -> Finding:
    """Judge whether the score is reached in as few steps as by another method, or nearly."""
    apart, mine, theirs = _beside(runs, other, steps_to_score)
    if never := sum(reached(run) is None for run in runs):
        return Finding(Verdict.NO, f"{never} of {len(runs)} runs never reached the score")
    near = mine.value <= SLOWER * theirs.value
    measured = f"{mine.text(0)} steps against {theirs.text(0)}"
    return Finding(_graded(apart.low <= 0, near), measured)


def beats_with_similar_violations(runs: Runs, other: Runs, name: str) -> Finding:
    """Judge whether the score is higher and the violations at the end differ by no interval."""
    scores = higher(runs, {name: other}, score)
    if scores.verdict is not Verdict.YES:
        return scores
    (apart,) = _differences(
        runs, {name: other}, lambda run: violations_per_episode(run)[1]
    ).values()
    measured = f"score {scores.measured}; violations per episode at the end {apart.text()}"
    return Finding(_graded(apart.low <= 0 <= apart.high, True), measured)


def _differences(runs: Runs, others: Mapping[str, Runs], value: Value) -> dict[str, Interval]:
    counts = {"this flow": len(runs), **{name: len(other) for name, other in others.items()}}
    if few := [f"{count} of {name}" for name, count in counts.items() if count < 2]:
        raise Untested("needs two runs or more of each, given " + ", ".join(few))
    mine = [value(run) for run in runs]
    return {name: difference(mine, [value(run) for run in other]) for name, other in others.items()}


def _beside(runs: Runs, other: Runs, value: Value) -> tuple[Interval, Interval, Interval]:
    """Return the difference of two methods, and each by itself."""
    (apart,) = _differences(runs, {"the other": other}, value).values()
    mine, theirs = (interquartile_mean([value(run) for run in group]) for group in (runs, other))
    return apart, mine, theirs


def _said(apart: Mapping[str, Interval], digits: int = 2) -> str:
    return "; ".join(f"{result.text(digits)} over {name}" for name, result in apart.items())


def _graded(yes: bool, partly: bool = False) -> Verdict:
    return Verdict.YES if yes else Verdict.PARTLY if partly else Verdict.NO


def _up_to(value: float, yes: float, partly: float) -> Verdict:
    return _graded(value <= yes, value <= partly)


FLOW_CLAIMS = (
    Claim(
        "The composed flow puts all its probability into the intersection of the constraints.",
        "reproduced without a single sample outside a set; else not",
        lambda _, flow: samples_outside(
            intersecting(Ball, Box),
            ", in {broken} of {cases} random cases of a ball and a box",
            flow,
        ),
    ),
    Claim(
        "That carries over to more than two constraints.",
        "reproduced without a single sample outside one of three sets; else not",
        lambda _, flow: samples_outside(
            intersecting(Ball, Ball, Box),
            ", in {broken} of {cases} random cases of two balls and a box",
            flow,
        ),
    ),
    Claim(
        "The order of application is a priority: where constraints are incompatible, the one "
        "applied last holds.",
        "reproduced without a single sample outside the last set; else not",
        lambda _, flow: samples_outside(
            incompatible(), " it, in {cases} random pairs without a common point", flow
        ),
    ),
    Claim(
        "Constraints are satisfied nearly perfectly from the first step of training to the last.",
        f"reproduced while no run has more than {QUASI:.1%} of violating steps, evaluations "
        f"included; partly up to {10 * QUASI:.0%}; else not",
        lambda e, flow: satisfaction(e.one(flow), QUASI, 10 * QUASI),
    ),
    Claim(
        "They are satisfied perfectly, as the same results are summed up.",
        "reproduced without a violating step in any run, evaluations included; partly while no run "
        f"has more than {QUASI:.1%} of them; else not",
        lambda e, flow: satisfaction(e.one(flow)),
    ),
    Claim(
        "The final return comes up to that of an agent that ignores the constraints.",
        "reproduced unless the interval of the difference of scores lies below 0; then partly from "
        f"{PAR:g} times its score on; else not (here the other passes through the rectangle and "
        "never has to charge: breaking the rules pays)",
        lambda e, flow: on_par(e.one(flow), e.one("unconstrained"), score),
    ),
    Claim(
        "It learns as quickly as an agent that ignores the constraints.",
        f"steps to a training score of {TARGET_SCORE:g}: reproduced unless the interval of the "
        f"difference lies above 0; then partly up to {SLOWER:g} times the steps; else not",
        lambda e, flow: as_fast(e.one(flow), e.one("unconstrained")),
    ),
    Claim(
        "Its final return is higher than with a reward penalty and with SAC-Lagrangian.",
        "reproduced if both intervals of the difference of scores lie above 0; partly if one does "
        "and none lies below; else not",
        lambda e, flow: higher(e.one(flow), e.of(*PENALIZED), score),
    ),
    Claim(
        "It learns faster than with a reward penalty and with SAC-Lagrangian.",
        f"steps saved to a training score of {TARGET_SCORE:g}: reproduced if both intervals lie "
        "above 0; partly if one does and none lies below; else not; a run that never came there "
        "counts with its whole budget, which is less than it would have needed",
        lambda e, flow: faster(e.one(flow), e.of(*PENALIZED)),
    ),
    Claim(
        "Every stage can be looked at, and explains what was done to an action and why.",
        "a claim about readers, which no run can decide; the pictures of stages, and `cnfp-audit`, "
        "which finds flaws of a mapping, are what it rests on",
        lambda e, flow: Finding(Verdict.UNTESTED, "see the figures"),
    ),
)
"""Of the paper, about its flow; each is judged for all of `FLOWS`."""

BASELINE_CLAIMS = (
    Claim(
        "Without constraints, with a penalty and with SAC-Lagrangian, many violations happen at "
        "the beginning.",
        "violating steps per episode in the first tenth of training: reproduced from 1 on in every "
        "run; partly if in some; else not",
        lambda e, _: violate_at_first(e.of("unconstrained", *PENALIZED)),
    ),
    Claim(
        "The penalty and SAC-Lagrangian reduce violations drastically over training.",
        "violating steps per episode, first to last tenth: reproduced if both fall "
        f"{FALL:g} times; partly if both fall {SOME_FALL:g} times; else not",
        lambda e, _: falls(e.of(*PENALIZED)),
    ),
    Claim(
        "SAC-Lagrangian ends with a higher return than the penalty, and similar violations.",
        "reproduced if the interval of the difference of scores lies above 0 and that of the last "
        "violations per episode holds 0; partly if only the first; else not",
        lambda e, _: beats_with_similar_violations(
            e.one("lagrangian"), e.one("penalty"), "the penalty"
        ),
    ),
)

AIMS = (
    Claim(
        "The exact flow: no violation in any run, from the first step to the last, evaluations "
        "included.",
        f"met without a single one; partly while no run has more than {QUASI:.1%} of violating "
        "steps; else not",
        lambda e, flow: satisfaction(e.one(flow)),
    ),
    Claim(
        "Its score is at least that of every constrained baseline.",
        "met if no interquartile mean is higher; partly if every difference to a higher one has 0 "
        "in its interval; else not",
        lambda e, flow: at_least(e.one(flow), e.baselines(), score),
    ),
    Claim(
        "Its area under the training score is at least that of every constrained baseline.",
        "met if no interquartile mean is higher; partly if every difference to a higher one has 0 "
        "in its interval; else not",
        lambda e, flow: at_least(e.one(flow), e.baselines(), area_under_score),
    ),
    Claim(
        "SAC-Lagrangian really trains: its violations per episode fall at least ten times.",
        f"first to last tenth of training: met from {FALL:g} times on; partly from "
        f"{SOME_FALL:g} times on; else not",
        lambda e, _: falls(e.of("lagrangian")),
    ),
    Claim(
        "Hostile networks behind the exact flow break nothing.",
        "met without a single violating step; else not",
        hostile,
    ),
    Claim(
        "A constraint switched on after training holds at once, without retraining.",
        "met without a single violating step; else not",
        lambda e, flow: afterwards(e.one(flow)),
    ),
)
"""Of this project, about the exact flow and its evidence."""
