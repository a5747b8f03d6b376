"""What claims are judged by, and the rules that one claim alone needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from cnfp_torchrl.geometry import Ball, Box
from experiments.paper.comparisons import higher
from experiments.paper.hostile import HostileRun
from experiments.paper.intersections import Tried, incompatible, intersecting
from experiments.paper.labels import Kind, label
from experiments.paper.records import MODES, Record
from experiments.paper.statistics import violations_per_episode
from experiments.paper.verdicts import Finding, Verdict, untested

STOCHASTIC = MODES[0]
PENALISED = ("penalty", "lagrangian")
BASELINES = ("squash", "projection", *PENALISED)
"""Constrained baselines that there must be runs of."""


@dataclass(frozen=True)
class Evidence:
    """All that claims are judged by.

    Args:
        runs: the records of each method.
        hostile: what hostile networks did, empty where that is not kept.
    """

    runs: dict[str, list[Record]]
    hostile: list[HostileRun]

    def of(self, *methods: str) -> dict[str, Sequence[Record]]:
        """Return the records of some methods by their labels, empty ones for those without."""
        return {label(each).look.label: self.runs.get(each, []) for each in methods}

    def constrained(self) -> dict[str, Sequence[Record]]:
        """Return the records of every constrained baseline, there or required."""
        others = (Kind.EXACT, Kind.IGNORED)
        there = [each for each in self.runs if label(each).kind not in others]
        return self.of(*dict.fromkeys((*BASELINES, *there)))


def score(run: Record) -> float:
    """Return the score of the stochastic policy after training."""
    return run.evaluation[STOCHASTIC].score


def support(evidence: Evidence, method: str) -> Finding:
    """Judge whether every sample lies in the intersection, also those of hostile networks."""
    return _outside(intersecting(Ball, Box), "a ball and a box", method)


def many_constraints(evidence: Evidence, method: str) -> Finding:
    """Judge whether every sample lies in the intersection of three sets."""
    return _outside(intersecting(Ball, Ball, Box), "two balls and a box", method)


def priority(evidence: Evidence, method: str) -> Finding:
    """Judge whether samples lie in the set of the highest priority where not all sets can hold."""
    tried = incompatible()
    measured = (
        f"{100 * tried.outside[method]:.1f} % of the samples outside it, in {tried.cases} random "
        "pairs without a common point"
    )
    return Finding(Verdict.NO if tried.broken[method] else Verdict.YES, measured)


def hostile(evidence: Evidence, method: str) -> Finding:
    """Judge whether hostile networks break nothing: yes without a single violating step."""
    runs = [run for run in evidence.hostile if run.flow == method]
    if not runs:
        return untested("no kept result")
    broken, steps = sum(sum(run.violations.values()) for run in runs), sum(r.steps for r in runs)
    measured = f"{broken:,} violating of {steps:,} steps, {len(runs)} networks"
    return Finding(Verdict.NO if broken else Verdict.YES, measured)


def afterwards(evidence: Evidence, method: str) -> Finding:
    """Judge whether a constraint switched on after training holds: yes without a violating step."""
    outcomes = [
        outcome
        for run in evidence.runs.get(method, [])
        for modes in run.afterwards.values()
        for outcome in modes.values()
    ]
    if not outcomes:
        return untested("no run was evaluated after a change")
    broken = sum(sum(each.violations.values()) for each in outcomes)
    measured = f"{broken:,} violating of {sum(each.steps for each in outcomes):,} steps"
    return Finding(Verdict.NO if broken else Verdict.YES, measured)


def lagrangian_beats_penalty(evidence: Evidence) -> Finding:
    """Judge return and violations of SAC-Lagrangian beside the penalty's.

    Yes if its score is higher and its violations at the end differ by no interval; partly if only
    the score is higher; else no.
    """
    mine, penalty = evidence.of("lagrangian", "penalty").values()
    scores = higher(mine, {"the penalty": penalty}, score)
    if scores.verdict is not Verdict.YES:
        return scores
    apart = higher(mine, {"the penalty": penalty}, lambda run: violations_per_episode(run)[1])
    less = higher(penalty, {"Lagrangian": mine}, lambda run: violations_per_episode(run)[1])
    similar = Verdict.YES not in (apart.verdict, less.verdict)
    measured = f"score {scores.measured}; violations per episode at the end {apart.measured}"
    return Finding(Verdict.YES if similar else Verdict.PARTLY, measured)


def _outside(tried: Tried, sets: str, method: str) -> Finding:
    measured = (
        f"{100 * tried.outside[method]:.1f} % of the samples outside, in {tried.broken[method]} of "
        f"{tried.cases} random cases of {sets}"
    )
    return Finding(Verdict.NO if tried.broken[method] else Verdict.YES, measured)
