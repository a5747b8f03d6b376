"""What an audit found: numbers with their uncertainty, examples, and a verdict."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

import torch
from torch import Tensor

from cnfp_torchrl.audit.table import as_text
from cnfp_torchrl.geometry import Region

TOGETHER = "together"
"""The name under which the intersection of all constraints is reported."""

_Z = 1.959964  # two-sided 95 %
_QUANTILES = {"min": 0.0, "q05": 0.05, "q25": 0.25, "median": 0.5, "q75": 0.75, "q95": 0.95}
_QUANTILES |= {"max": 1.0}

Quantiles = dict[str, float | None]
"""``min``, ``q05``, ``q25``, ``median``, ``q75``, ``q95``, ``max``."""


@dataclass(frozen=True)
class Share:
    """A share of samples with a 95 % interval.

    Args:
        count: how many.
        of: out of how many.
        share: ``count / of``; None without samples.
        low: lower end of the interval.
        high: upper end of the interval.
    """

    count: int
    of: int
    share: float | None
    low: float
    high: float

    @classmethod
    def clustered(cls, hits: Tensor, totals: Tensor) -> Share:
        """Return a share of samples that come in clusters, the actions tried in one state.

        Wilson's interval, with the sample size that independent samples of the same variance would
        have: actions in one state are alike, so that their number says too much. Where all states
        agree on 0 or 1, the number of states counts.

        Args:
            hits: in each cluster, ``(n,)``.
            totals: of each cluster, ``(n,)``; clusters without samples count for nothing.
        """
        hits, totals = hits[totals > 0].double(), totals[totals > 0].double()
        clusters, of = len(totals), int(totals.sum())
        if of == 0:
            return cls(0, 0, None, 0.0, 1.0)
        count = int(hits.sum())
        share = count / of
        if clusters == 1 or count in (0, of):
            return cls(count, of, share, *wilson(share, clusters))
        spread = float((hits - share * totals).square().sum()) * clusters / (clusters - 1)
        size = share * (1 - share) * of**2 / spread if spread > 0 else of
        return cls(count, of, share, *wilson(share, min(size, of)))


def wilson(share: float, size: float) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share that was seen in a sample of some size."""
    weight = _Z**2 / size
    middle = (share + weight / 2) / (1 + weight)
    half = math.sqrt(weight * share * (1 - share) + weight**2 / 4) / (1 + weight)
    # Exactly at the ends, where rounding would leave out the share itself.
    low = 0.0 if share == 0 else max(middle - half, 0.0)
    return low, 1.0 if share == 1 else min(middle + half, 1.0)


def quantiles(values: Tensor) -> Quantiles:
    """Return quantiles of values ``(n,)``; None where there are none or they are infinite."""
    if len(values) == 0:
        return dict.fromkeys(_QUANTILES)
    at = torch.tensor(list(_QUANTILES.values()), dtype=torch.float64, device=values.device)
    # Interpolation between infinities would be NaN.
    found = torch.quantile(values.double(), at, interpolation="nearest").tolist()
    return {
        name: value if math.isfinite(value) else None
        for name, value in zip(_QUANTILES, found, strict=True)
    }


def plain(value: Tensor) -> Any:
    """Return a tensor as nested lists that JSON can hold; infinity and NaN become strings."""
    return _finite(value.tolist())


def _finite(value: Any) -> Any:
    if isinstance(value, list):
        return [_finite(each) for each in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


@dataclass(frozen=True)
class Findings:
    """What was found about one constraint, or about all of them together, in one set of states.

    Args:
        name: of the constraint, or `TOGETHER`.
        unsound: of the actions inside its set, those that its indicator calls a violation; None
            without an indicator.
        escaped: of the flow's samples, those outside the set though it is active.
        dead_ends: of the flow's samples that break nothing in states where everything is active,
            those that led to a state in which it has to be dropped.
        coverage: of the actions that its indicator allows, those inside its set; together, those
            that the flow can reach. Where it is active.
        binding: the same, over those of the states in which the set leaves out any tried action.
        dropped: of the states, those in which it is not active; together, any of them.
        possible: of those, the ones in which some tried action keeps the indicator for a step.
        volume: the share of the action bounds that it leaves, over the states where it is active.
        slack: at the anchor, in action units, over the same states.
        examples: states by kind of finding (``unsound``, ``escaped``, ``dead_ends``, ``dropped``),
            the worst ones first.
    """

    name: str
    unsound: Share | None
    escaped: Share
    dead_ends: Share
    coverage: Share | None
    binding: Share | None
    dropped: Share
    possible: Share | None
    volume: Quantiles
    slack: Quantiles
    examples: dict[str, list[dict[str, Any]]]


@dataclass(frozen=True)
class Executed:
    """What happened while the policy acted.

    Args:
        steps: how many were taken.
        violations: of each indicator, over all steps.
        led_into: of those, the violations in episodes in which the constraint had been active
            before: allowed actions led from a state where it held to its violation.
        examples: for each constraint, the last state in which it was active, with the action.
    """

    steps: int
    violations: dict[str, int]
    led_into: dict[str, int]
    examples: dict[str, list[dict[str, Any]]]


@dataclass(frozen=True)
class Scene:
    """One state with every action that was tried in it, for pictures.

    Args:
        name: of the constraint that it tells most about.
        source: where the state comes from.
        why: what makes the state the worst one.
        state: its entries.
        region: sets, anchor and flags, of batch shape ``()``.
        actions: ``(m, d)``.
        inside: whether each lies in the constraint's set, ``(m,)``.
        violates: whether the indicator calls it a violation, ``(m,)``.
        dead_end: whether the constraint had to be dropped after it, ``(m,)``.
    """

    name: str
    source: str
    why: str
    state: dict[str, Any]
    region: Region
    actions: Tensor
    inside: Tensor
    violates: Tensor
    dead_end: Tensor


@dataclass(frozen=True)
class AuditReport:
    """Everything that an audit found; as a string, tables and the verdict.

    Args:
        subject: what was audited: flow, order, policy, how actions were judged, settings.
        sources: findings by where the states came from, then constraint; the last one is
            `TOGETHER`.
        executed: what happened in the rollouts.
        order: the constraints in order of application.
        notes: what the numbers leave out.
        strict: whether dead ends are flaws.
        scenes: one for each constraint; not part of `as_dict`.
    """

    subject: dict[str, Any]
    sources: dict[str, list[Findings]]
    executed: Executed
    order: tuple[str, ...]
    notes: tuple[str, ...] = ()
    strict: bool = False
    scenes: tuple[Scene, ...] = field(default=(), repr=False)

    def __str__(self) -> str:
        return as_text(self)

    @property
    def flaws(self) -> list[str]:
        """What must not be.

        Unsound sets, sets that never hold, a flow that leaves its sets, ways into a violation.
        """
        return list(self._flaws())

    def _flaws(self) -> Iterator[str]:
        for source, findings in self.sources.items():
            *single, together = (self._flaws_of(each, source) for each in findings)
            # All together fail where one does: told once.
            yield from [flaw for flaws in single for flaw in flaws] or together
        yield from self._never_active()
        for name, count in self.executed.led_into.items():
            if count:
                yield (
                    f"{name}, rollouts: the policy was led into {count} violations from states in "
                    f"which the constraint was active, in {self.executed.steps} steps"
                )

    def _never_active(self) -> Iterator[str]:
        for name in self.order:
            found = [each for many in self.sources.values() for each in many if each.name == name]
            states = sum(each.dropped.of for each in found)
            if states > sum(each.dropped.count for each in found):
                continue
            possible = sum(each.possible.count for each in found if each.possible is not None)
            if possible:
                yield (
                    f"{name}: dropped in all of {states} states, in {possible} of which its "
                    "indicator allows an action"
                )

    def _flaws_of(self, found: Findings, source: str) -> list[str]:
        kinds = [(found.unsound, "actions inside the set violate the indicator")]
        kinds += [(found.escaped, "samples of the flow lie outside the active set")]
        if self.strict:
            kinds += [(found.dead_ends, "allowed actions led to where it must be dropped")]
        return [
            f"{found.name}, {source}: {share.count} of {share.of} {what}"
            for share, what in kinds
            if share is not None and share.count
        ]

    def as_dict(self) -> dict[str, Any]:
        """Return the report as plain values, for JSON."""
        return {
            "flaws": self.flaws,
            "subject": self.subject,
            "order": list(self.order),
            "notes": list(self.notes),
            "sources": {
                source: {each.name: asdict(each) for each in findings}
                for source, findings in self.sources.items()
            },
            "executed": asdict(self.executed),
        }
