"""How often each constraint held, gave way, and was broken."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Self

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import EnvBase

from cnfp_torchrl.envs import counted_constraints, refuse_misnamed_judges
from cnfp_torchrl.keys import (
    CONSTRAINT_STATES,
    CONSTRAINTS_KEY,
    COST_KEY,
    RESERVED_NAMES,
    active_key,
    relaxation_key,
)

NOT_COUNTED = "not counted"
"""The text in place of a count where nothing judges a constraint, which is not a count of 0."""


class UncountedConstraintWarning(UserWarning):
    """A constraint has no judge of its name, so that nobody counts its violations."""


@dataclass(frozen=True)
class ConstraintCounts:
    """Counts of one constraint over a number of steps; two of them can be added.

    Args:
        violations: The number of violating steps; None where nothing judges the constraint.
        steps: The number of steps by what the constraint was in their states
            (`cnfp_torchrl.keys.CONSTRAINT_STATES`); empty where the environment does not tell.
        violations_while: The number of violating steps by the same; empty where either is unknown.
        largest_relaxation: The largest amount by which it was relaxed, in units of its slack.
        total_relaxation: The sum of the amounts over the steps in which it was relaxed.
    """

    violations: int | None = None
    steps: Mapping[str, int] = field(default_factory=dict)
    violations_while: Mapping[str, int] = field(default_factory=dict)
    largest_relaxation: float = 0.0
    total_relaxation: float = 0.0

    def __add__(self, other: ConstraintCounts) -> ConstraintCounts:
        counted = self.violations is not None and other.violations is not None
        return ConstraintCounts(
            (self.violations or 0) + (other.violations or 0) if counted else None,
            _sum(self.steps, other.steps),
            _sum(self.violations_while, other.violations_while),
            max(self.largest_relaxation, other.largest_relaxation),
            self.total_relaxation + other.total_relaxation,
        )

    @property
    def mean_relaxation(self) -> float:
        """The mean amount over the steps in which it was relaxed; 0 without any."""
        return self.total_relaxation / max(self.steps.get("relaxed", 0), 1)

    def share(self, state: str) -> float:
        """Return the share of steps in which the constraint was active, relaxed or dropped."""
        return self.steps[state] / max(sum(self.steps.values()), 1)

    def report(self) -> dict[str, Any]:
        """Return the counts as plain values."""
        values = asdict(self)
        del values["total_relaxation"]
        return values | {"mean_relaxation": self.mean_relaxation}


def _sum(first: Mapping[str, int], second: Mapping[str, int]) -> dict[str, int]:
    return {name: first[name] + second[name] for name in first if name in second}


class ConstraintTally:
    """Count steps and violations of each constraint, on the device until `counts` is called.

    Args:
        judged: The names of the columns of ``cost``.
        constraints: The names of the constraints that have geometry.
        published: The names of those whose active flag and relaxation are in the tensordict.
    """

    def __init__(
        self, judged: Sequence[str], constraints: Sequence[str] = (), published: Sequence[str] = ()
    ) -> None:
        self.judged, self.constraints, self.published = (
            tuple(judged),
            tuple(constraints),
            tuple(published),
        )
        self._judged_published = [name for name in published if name in judged]
        self._sums: dict[str, Tensor] = {}

    @classmethod
    def of(cls, env: EnvBase) -> Self:
        """Return the tally of an environment; warns of constraints that nothing judges.

        Raises:
            ValueError: when one has no judge but there is a judge of nearly its name.
        """
        judged = counted_constraints(env)
        geometry = env.observation_spec.get(CONSTRAINTS_KEY, None)
        entries = geometry.items() if isinstance(geometry, Composite) else ()
        specs = {name: spec for name, spec in entries if name not in RESERVED_NAMES}
        refuse_misnamed_judges(tuple(specs), judged)
        missed = [name for name in specs if name not in judged]
        if missed:
            given = f"cost has columns for {list(judged)}" if judged else "it has no cost"
            warnings.warn(
                f"constraints {missed}: expected a judge of the same name in the environment, but "
                f"{given}: their violations are {NOT_COUNTED}; append ConstraintCost({{NAME: "
                "indicator}), or give geometry and judge one name",
                UncountedConstraintWarning,
                stacklevel=2,
            )
        published = [name for name, spec in specs.items() if active_key(name)[-1] in spec.keys()]  # noqa: SIM118
        return cls(judged, tuple(specs), published)

    def fresh(self) -> ConstraintTally:
        """Return another tally of the same constraints, which has counted nothing."""
        return ConstraintTally(self.judged, self.constraints, self.published)

    def add(self, transitions: TensorDictBase, counts: Tensor | None = None) -> None:
        """Count transitions of any batch shape.

        Args:
            transitions: The states with active flags and relaxations, and the costs under ``next``.
            counts: The mask of the transitions that count, in the order of the flattened batch;
                None means all.
        """
        batch = transitions.reshape(-1)
        for name, value in self._measured(batch, counts):
            before = self._sums.get(name)
            if before is not None:
                value = torch.maximum(before, value) if name == "largest" else before + value
            self._sums[name] = value

    def _measured(
        self, batch: TensorDictBase, counts: Tensor | None
    ) -> Iterator[tuple[str, Tensor]]:
        violated: Tensor | None = None
        if self.judged:
            violated = batch.get(("next", COST_KEY)).reshape(len(batch), -1).double()
            if counts is not None:
                violated = violated * counts.unsqueeze(-1)
            yield "violations", violated.sum(0)
        if not self.published:
            return
        active = torch.stack([batch.get(active_key(name)) for name in self.published], -1)
        amount = torch.stack([batch.get(relaxation_key(name)) for name in self.published], -1)
        relaxed = ~active & amount.isfinite()
        states = torch.stack([active, relaxed, ~active & ~relaxed], -1)
        if counts is not None:
            states = states & counts[:, None, None]
            relaxed = states[..., 1]
        yield "steps", states.double().sum(0)
        amount = torch.where(relaxed, amount.double(), 0.0)
        yield "largest", amount.amax(0)
        yield "total", amount.sum(0)
        if violated is not None and self._judged_published:
            columns = violated[:, [self.judged.index(name) for name in self._judged_published]]
            rows = [self.published.index(name) for name in self._judged_published]
            yield "while", (states[:, rows] * columns.unsqueeze(-1)).sum(0)

    def state_dict(self) -> dict[str, Tensor]:
        """Return the sums."""
        return dict(self._sums)

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Go on counting from sums that `state_dict` has returned."""
        self._sums = dict(state)

    def counts(self) -> dict[str, ConstraintCounts]:
        """Return the counts by constraint: those that are judged first, then the others."""
        sums = {name: value.tolist() for name, value in self._sums.items()}
        names = [*self.judged, *(name for name in self.constraints if name not in self.judged)]
        return {name: self._counts_of(name, sums) for name in names}

    def _counts_of(self, name: str, sums: Mapping[str, Any]) -> ConstraintCounts:
        def by_state(key: str, names: Sequence[str]) -> dict[str, int]:
            if name not in names:
                return {}
            row = sums[key][names.index(name)] if key in sums else [0.0] * len(CONSTRAINT_STATES)
            return {
                state: round(count) for state, count in zip(CONSTRAINT_STATES, row, strict=True)
            }

        def value(key: str, names: Sequence[str]) -> float:
            return sums[key][names.index(name)] if key in sums and name in names else 0.0

        return ConstraintCounts(
            round(value("violations", self.judged)) if name in self.judged else None,
            by_state("steps", self.published),
            by_state("while", self._judged_published),
            value("largest", self.published),
            value("total", self.published),
        )


def violations_of(counts: Mapping[str, ConstraintCounts]) -> dict[str, int | None]:
    """Return the violating steps by constraint, None for those that nothing judges."""
    return {name: count.violations for name, count in counts.items()}


def constraint_reports(counts: Mapping[str, ConstraintCounts]) -> dict[str, dict[str, Any]]:
    """Return the counts of the constraints whose active flag is published, as plain values."""
    return {name: count.report() for name, count in counts.items() if count.steps}


def count_text(violations: int | None) -> str:
    """Return a number of violations as text."""
    return NOT_COUNTED if violations is None else str(violations)


def gave_way_text(report: Mapping[str, Any]) -> str:
    """Return a phrase on how often a constraint gave way or was broken, "" if never."""
    steps: Mapping[str, int] = report["steps"]
    total, broken = sum(steps.values()), report["violations_while"]
    phrases = []
    for state in CONSTRAINT_STATES[1:]:
        if count := steps[state]:
            largest = f" by up to {report['largest_relaxation']:.3g} action units"
            amount = largest if state == "relaxed" else ""
            phrases.append(f"{state}{amount} in {100 * count / total:.3g} % of steps")
    if phrases or any(broken.values()):
        counts = ", ".join(f"{count} while {state}" for state, count in broken.items())
        phrases.append(f"violations: {counts or NOT_COUNTED}")
    return "; ".join(phrases)
