"""The paper's claims and this project's aims, each with the rule that judges it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from experiments.paper.comparisons import as_fast, at_least, faster, higher, on_par
from experiments.paper.judgments import (
    PENALISED,
    Evidence,
    afterwards,
    hostile,
    lagrangian_beats_penalty,
    many_constraints,
    priority,
    score,
    support,
)
from experiments.paper.statistics import area_under_score
from experiments.paper.verdicts import (
    Finding,
    falls,
    near_satisfaction,
    satisfaction,
    untested,
    violate_at_first,
)


@dataclass(frozen=True)
class Claim:
    """A claim about methods.

    Args:
        statement: what is claimed.
        rule: when which verdict falls, in words.
        judge: by the evidence.
    """

    statement: str
    rule: str
    judge: Callable[[Evidence], Finding]


@dataclass(frozen=True)
class FlowClaim:
    """A claim about a flow; see `Claim`, but it is judged for the method of one flow."""

    statement: str
    rule: str
    judge: Callable[[Evidence, str], Finding]


FLOW_CLAIMS = (
    FlowClaim(
        "The composed flow puts all its probability into the intersection of the constraints.",
        "reproduced without a single sample outside a set; else not",
        support,
    ),
    FlowClaim(
        "That carries over to more than two constraints.",
        "the same, with three sets",
        many_constraints,
    ),
    FlowClaim(
        "The order of application is a priority: where constraints are incompatible, the one "
        "applied last holds.",
        "reproduced without a single sample outside the last set; else not",
        priority,
    ),
    FlowClaim(
        "Constraints are satisfied nearly perfectly from the first step of training to the last.",
        "reproduced while no run has more than 1 violating step in 1,000, evaluations included; "
        "partly up to 1 in 100; else not",
        lambda evidence, method: near_satisfaction(evidence.runs.get(method, [])),
    ),
    FlowClaim(
        "They are satisfied perfectly, as the same results are summed up.",
        "reproduced without a violating step in any run, evaluations included; partly while no run "
        "has more than 1 in 1,000; else not",
        lambda evidence, method: satisfaction(evidence.runs.get(method, [])),
    ),
    FlowClaim(
        "The final return comes up to that of an agent that ignores the constraints.",
        "reproduced unless the interval of the difference of scores lies below 0; then partly from "
        "0.9 times its score on; else not (here the other passes through the rectangle and never "
        "has to charge: breaking the rules pays)",
        lambda e, m: on_par(e.runs.get(m, []), e.runs.get("unconstrained", []), score),
    ),
    FlowClaim(
        "It learns as quickly as an agent that ignores the constraints.",
        "steps to a training score of 0.75: reproduced unless the interval of the difference lies "
        "above 0; then partly up to 1.5 times the steps; else not",
        lambda e, m: as_fast(e.runs.get(m, []), e.runs.get("unconstrained", [])),
    ),
    FlowClaim(
        "Its final return is higher than with a reward penalty and with SAC-Lagrangian.",
        "reproduced if both intervals of the difference of scores lie above 0; partly if one does "
        "and none lies below; else not",
        lambda e, m: higher(e.runs.get(m, []), e.of(*PENALISED), score),
    ),
    FlowClaim(
        "It learns faster than with a reward penalty and with SAC-Lagrangian.",
        "the same, with the steps saved to a training score of 0.75; a run that never came there "
        "counts with its whole budget",
        lambda e, m: faster(e.runs.get(m, []), e.of(*PENALISED)),
    ),
    FlowClaim(
        "Every stage can be looked at, and explains what was done to an action and why.",
        "a claim about readers, which no run can decide; the pictures of stages below, and "
        "`cnfp-audit`, which finds flaws of a mapping, are what it rests on",
        lambda e, m: untested("see the figures"),
    ),
)
"""Of the paper, about its flow; each is judged for its own chain and for the exact flow."""

BASELINE_CLAIMS = (
    Claim(
        "Without constraints, with a penalty and with SAC-Lagrangian, many violations happen at "
        "the beginning.",
        "violating steps per episode in the first tenth of training: reproduced from 1 on in every "
        "run; partly if in some; else not",
        lambda e: violate_at_first(e.of("unconstrained", *PENALISED)),
    ),
    Claim(
        "The penalty and SAC-Lagrangian reduce violations drastically over training.",
        "violating steps per episode, first to last tenth: reproduced if both fall 10 times; "
        "partly if both fall 2 times; else not",
        lambda e: falls(e.of(*PENALISED)),
    ),
    Claim(
        "SAC-Lagrangian ends with a higher return than the penalty, and similar violations.",
        "reproduced if the interval of the difference of scores lies above 0 and that of the last "
        "violations per episode holds 0; partly if only the first; else not",
        lagrangian_beats_penalty,
    ),
)

AIMS = (
    Claim(
        "The exact flow: no violation in any run, from the first step to the last, evaluations "
        "included.",
        "met without a single one; partly while no run has more than 1 in 1,000 steps; else not",
        lambda e: satisfaction(e.runs.get("exact", [])),
    ),
    Claim(
        "Its score is at least that of every constrained baseline.",
        "met if no interquartile mean is higher; partly if every difference to a higher one has 0 "
        "in its interval; else not",
        lambda e: at_least(e.runs.get("exact", []), e.constrained(), score),
    ),
    Claim(
        "Its area under the training score is at least that of every constrained baseline.",
        "the same",
        lambda e: at_least(e.runs.get("exact", []), e.constrained(), area_under_score),
    ),
    Claim(
        "SAC-Lagrangian really trains: its violations per episode fall at least ten times.",
        "first to last tenth of training: met from 10 times on; partly from 2 times on; else not",
        lambda e: falls(e.of("lagrangian")),
    ),
    Claim(
        "Hostile networks behind the exact flow break nothing.",
        "met without a single violating step; else not",
        lambda e: hostile(e, "exact"),
    ),
    Claim(
        "A constraint switched on after training holds at once, without retraining.",
        "the same",
        lambda e: afterwards(e, "exact"),
    ),
)
"""Of this project."""
