"""The report of an audit: numbers with their uncertainty, examples, tables and a verdict."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from textwrap import fill
from typing import Any

from torch import Tensor

from cnfp_torchrl.audit.distortion import Distortion
from cnfp_torchrl.audit.statistics import Quantiles, Share
from cnfp_torchrl.geometry import Region
from cnfp_torchrl.keys import CONSTRAINT_STATES
from cnfp_torchrl.text_table import text_table

TOGETHER = "together"
"""The name under which the intersection of all constraints is reported."""


@dataclass(frozen=True)
class ConstraintMetrics:
    """Measurements of one constraint, or of all of them together, in one set of states.

    Args:
        name: The constraint's name, or `TOGETHER`.
        unsound: The share of the actions inside its set, where it is active, that its indicator
            calls a violation; None without an indicator.
        escaped: The share of the flow's samples that lie outside the set, widened where it is
            relaxed.
        dead_ends: The share, of the flow's samples that break nothing in states where everything is
            active, of those that led to a state in which it gives way.
        coverage: The share of the actions that its indicator allows inside its set; together, of
            those that the flow can reach. Where it is active.
        binding: Coverage in the states where the set leaves out any tried action.
        relaxed: The share of the states in which it is relaxed; together, in which one is and none
            is dropped.
        dropped: The share of the states in which it is dropped; together, in which any is.
        gave_way: The share of the states in which it is either.
        had: The share of the states in which it is active, or relaxed by no more than a set without
            interior needs (`cnfp_torchrl.geometry.relaxation_floor`).
        relaxation: Quantiles of the amount over the states in which it is relaxed, in units of its
            slack; together of the largest one.
        possible: The share of the states in which it gives way in which some tried action keeps its
            indicator for a step.
        volume: Quantiles of its share of the action bounds, over the states where it is active.
        slack: Quantiles of the anchor's slack, in action units, over the same states.
        examples: States by kind of flaw (``unsound``, ``escaped``, ``dead_ends``, ``gave_way``),
            the worst ones first.
    """

    name: str
    unsound: Share | None
    escaped: Share
    dead_ends: Share
    coverage: Share | None
    binding: Share | None
    relaxed: Share
    dropped: Share
    gave_way: Share
    had: Share
    relaxation: Quantiles
    possible: Share | None
    volume: Quantiles
    slack: Quantiles
    examples: dict[str, list[dict[str, Any]]]


@dataclass(frozen=True)
class Executed:
    """Counts of what happened while the policy acted.

    Args:
        steps: The number of steps.
        violations: The number of violations by indicator, over all steps.
        led_into: The number of those in episodes in which the constraint had been active before:
            allowed actions led from a state where it held to its violation.
        examples: The last states in which each constraint was active, with the action.
        states: The number of steps by constraint, then by what it was in their states, see
            `CONSTRAINT_STATES`.
        violations_while: The number of violations by the same, of constraints with an indicator.
    """

    steps: int
    violations: dict[str, int]
    led_into: dict[str, int]
    examples: dict[str, list[dict[str, Any]]]
    states: dict[str, dict[str, int]]
    violations_while: dict[str, dict[str, int]]


@dataclass(frozen=True)
class WorstState:
    """The state that speaks most against a constraint's set, with every action tried in it.

    Args:
        name: The constraint's name.
        source: The state's source, such as ``rollouts``.
        reason: The wording of what makes the state the worst one.
        state: The state's entries.
        region: Sets, anchor and flags, of batch shape ``()``.
        actions: The actions tried, ``(m, d)``.
        inside: The mask of the actions in the constraint's set, ``(m,)``.
        violates: The mask of the actions that the indicator calls violations, ``(m,)``.
        dead_end: The mask of the actions after which the constraint had to give way, ``(m,)``.
    """

    name: str
    source: str
    reason: str
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
        subject: Names of environment, flow and policy, and the settings.
        sources: Measurements by where the states came from, then constraint; the last one is
            `TOGETHER`.
        executed: Counts of the rollouts.
        order: The constraints in order of application.
        notes: Remarks on what the numbers leave out.
        strict: The flag that makes dead ends flaws.
        worst_states: Worst states, one for each constraint, for pictures; not part of `as_dict`.
        distortion: What the flow does to allowed actions, by the states' source; empty for flows
            that are not safe.
    """

    subject: dict[str, Any]
    sources: dict[str, list[ConstraintMetrics]]
    executed: Executed
    order: tuple[str, ...]
    notes: tuple[str, ...] = ()
    strict: bool = False
    worst_states: tuple[WorstState, ...] = field(default=(), repr=False)
    distortion: dict[str, Distortion] = field(default_factory=dict)

    def __str__(self) -> str:
        return "\n\n".join(_paragraphs(self))

    @property
    def flaws(self) -> list[str]:
        """What must not be.

        Unsound sets, sets that never hold, a flow that leaves its sets, ways into a violation.
        """
        return list(self._flaws())

    def _flaws(self) -> Iterator[str]:
        for source, measured in self.sources.items():
            *single, together = (self._flaws_of(metrics, source) for metrics in measured)
            # All together fail where one does: reported once.
            yield from [flaw for flaws in single for flaw in flaws] or together
        yield from self._never_had()
        for name, count in self.executed.led_into.items():
            if count:
                yield (
                    f"{name}, rollouts: the policy was led into {count} violations from states in "
                    f"which the constraint was active, in {self.executed.steps} steps"
                )

    def _never_had(self) -> Iterator[str]:
        for name in self.order:
            found = [x for measured in self.sources.values() for x in measured if x.name == name]
            if any(metrics.had.count for metrics in found):
                # A set without interior, whose actions only the executed steps judge.
                broken = self.executed.violations_while.get(name, {}).get("relaxed", 0)
                if broken and not any(x.gave_way.count < x.gave_way.of for x in found):
                    yield (
                        f"{name}: too narrow a set in all states, so that it is widened a little, "
                        f"and {broken} of {self.executed.steps} executed steps violate the "
                        "indicator; widen the set, or give the indicator a tolerance"
                    )
                continue
            relaxed = sum(metrics.relaxed.count for metrics in found)
            dropped = sum(metrics.dropped.count for metrics in found)
            least = min((x for m in found if (x := m.relaxation["min"]) is not None), default=0.0)
            how = [f"relaxed in {relaxed}, by {least:.3g} or more"] if relaxed else []
            how += [f"dropped in {dropped}"] if dropped else []
            possible = [metrics.possible.count for metrics in found if metrics.possible is not None]
            judged = f"; its indicator allows an action in {sum(possible)} of them"
            yield (
                f"{name}: holds in none of {relaxed + dropped} states, {', '.join(how)}"
                f"{judged if possible else ''}"
            )

    def _flaws_of(self, found: ConstraintMetrics, source: str) -> list[str]:
        kinds = [(found.unsound, "actions inside the set violate the indicator")]
        kinds += [(found.escaped, "samples of the flow lie outside the set")]
        if self.strict:
            kinds += [(found.dead_ends, "allowed actions led to where it gives way")]
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
                source: {metrics.name: asdict(metrics) for metrics in measured}
                for source, measured in self.sources.items()
            },
            "executed": asdict(self.executed),
            "distortion": {source: asdict(found) for source, found in self.distortion.items()},
        }


_Columns = dict[str, Callable[[ConstraintMetrics], str]]

_SOUNDNESS: _Columns = {
    "unsound": lambda x: _count(x.unsound),
    "escaped": lambda x: _count(x.escaped),
    "dead ends": lambda x: _count(x.dead_ends),
}
_RELAXATION: _Columns = {
    "relaxed": lambda x: _percent(x.relaxed),
    "by (largest)": lambda x: f"{_number(x.relaxation['median'])} ({_number(x.relaxation['max'])})",
    "dropped": lambda x: _percent(x.dropped),
    "though possible": lambda x: _percent(x.possible),
}
_COVERAGE: _Columns = {
    "coverage": lambda x: _percent(x.coverage, interval=True),
    "binding": lambda x: _percent(x.binding),
    "volume (5-95 %)": lambda x: _percentiles(x.volume),
    "anchor slack (least)": lambda x: f"{_number(x.slack['median'])} ({_number(x.slack['min'])})",
}
"""Columns of the three tables, each of which fits a terminal of 100 columns."""

_DISTORTION: dict[str, Callable[[Distortion], str]] = {
    "moved (95 %)": lambda x: f"{_number(x.moved['median'])} ({_number(x.moved['q95'])})",
    "smallest (5 %)": lambda x: f"{_number(x.smallest['median'])} ({_number(x.smallest['q05'])})",
    "largest (95 %)": lambda x: f"{_number(x.largest['median'])} ({_number(x.largest['q95'])})",
    "samples on the boundary": lambda x: _percent(x.on_boundary),
}

_LEGEND = """\
unsound: actions inside the active set that the environment's indicator calls violations
escaped: samples of the flow outside the set, widened where it is relaxed
dead ends: allowed actions after which the constraint gives way
relaxed: states in which the set is widened, because it cannot hold or yields to others; by how
  much, in units of its slack, median over them
dropped: states in which the constraint does not count, for the same reasons
though possible: states of both in which some action keeps its indicator for one step
coverage: share of the actions allowed by the indicators, one step ahead, that the set lets the flow
  reach, with a 95 % interval over states; below 100 % is no flaw where a set plans further ahead
binding: the coverage in states where the set leaves some action out
volume: share of the action bounds inside the set, median over states
anchor slack: of the anchor, in action units, median over states
allowed actions: how far the flow moves wished actions that are allowed already, as a share of the
  way from the anchor to the boundary, and its smallest and largest slope there, medians; 1 leaves
  them alone. Samples on the boundary: of latents N(0, 1), up to rounding in float32"""


def _paragraphs(report: AuditReport) -> Iterator[str]:
    subject = report.subject
    yield (
        f"{subject['environment']}, {subject['flow']}, order {' < '.join(report.order)}; states of "
        f"{' and '.join(report.sources)}, policy: {subject['policy']}"
    )
    for columns in (_SOUNDNESS, _RELAXATION, _COVERAGE):
        rows = [["states", "constraint", *columns]]
        for source, measured in report.sources.items():
            rows += [
                [source, metrics.name, *(cell(metrics) for cell in columns.values())]
                for metrics in measured
            ]
        yield text_table(rows)
    if report.distortion:
        rows = [["allowed actions", *_DISTORTION]]
        for source, found in report.distortion.items():
            rows.append([source, *(cell(found) for cell in _DISTORTION.values())])
        yield text_table(rows)
    yield _LEGEND
    executed = report.executed
    rows = [
        [
            "executed",
            "violations",
            *(f"while {state}" for state in CONSTRAINT_STATES),
            "after it had held",
        ]
    ]
    unjudged = [name for name in report.order if name not in executed.violations]
    for name in [*executed.violations, *unjudged]:
        counts = [executed.violations.get(name, "not counted")]
        while_state = executed.violations_while.get(name, {})
        counts += [while_state.get(state, "-") for state in CONSTRAINT_STATES]
        counts += [executed.led_into.get(name, "-" if name in unjudged else "no geometry")]
        rows.append([name, *map(str, counts)])
    yield f"{text_table(rows)}\nin {executed.steps} steps of the policy"
    if report.notes:
        yield _wrapped("note: ", report.notes)
    yield from _examples(report)
    flaws = report.flaws
    not_judged = f"; {', '.join(unjudged)}: not judged" if unjudged else ""
    yield _wrapped("FLAW: ", flaws) if flaws else f"no flaw found{not_judged}"


def _wrapped(prefix: str, sentences: Iterable[str]) -> str:
    """Return sentences below each other, of lines as wide as the tables may be."""
    return "\n".join(
        fill(
            f"{prefix}{sentence}",
            100,
            subsequent_indent="  ",
            break_long_words=False,
            break_on_hyphens=False,
        )
        for sentence in sentences
    )


def _examples(report: AuditReport) -> Iterator[str]:
    """Yield the worst example of each kind of flaw, with the state it fails in."""
    names = report.subject["names"]
    for source, measured in report.sources.items():
        for kind in ("unsound", "escaped", "dead_ends"):
            *single, together = measured
            # Those of all together are shown where they are no constraint's own.
            for metrics in [x for x in single if x.examples[kind]] or [together]:
                for example in metrics.examples[kind][:1]:
                    name = kind.replace("_", " ")
                    yield _example(f"{metrics.name}, {source}, worst of {name}", example, names)
    for name, examples in report.executed.examples.items():
        for example in examples[:1]:
            yield _example(f"{name}, rollouts, the last state in which it held", example, names)


def _example(title: str, example: dict[str, Any], names: Mapping[str, Sequence[str]]) -> str:
    shown = {key: value for key, value in example.items() if key != "sets"}
    lines = [f"{key}: {_named(key, value, names)}" for key, value in shown.items()]
    lines += [f"set of {name}: {_short(fields)}" for name, fields in example["sets"].items()]
    return f"{title}\n" + "\n".join(f"  {line}" for line in lines)


def _named(key: str, value: Any, names: Mapping[str, Sequence[str]]) -> str:
    """Return a value in words, a vector by the names of its components, where these have some."""
    if isinstance(value, dict):
        entries = (f"{name} {_named(name, inner, names)}" for name, inner in value.items())
        return ", ".join(entries)
    titles = names.get(key, ())
    if isinstance(value, list) and len(value) == len(titles):
        parts = (f"{title} {_short(x)}" for title, x in zip(titles, value, strict=True))
        return f"[{', '.join(parts)}]"
    return _short(value)


def _short(value: Any) -> str:
    """Return a plain value with numbers to six digits; the JSON file has all of them."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {_short(inner)}" for name, inner in value.items())
    if isinstance(value, list):
        return f"[{', '.join(map(_short, value))}]"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _count(share: Share | None) -> str:
    return "not judged" if share is None else f"{share.count} of {share.of}"


def _percent(share: Share | None, *, interval: bool = False) -> str:
    if share is None:
        return "not judged"
    if share.share is None:
        return "-"
    percent = f"{100 * share.share:.1f} %"
    return f"{percent} [{100 * share.low:.1f}, {100 * share.high:.1f}]" if interval else percent


def _percentiles(found: Quantiles) -> str:
    if found["median"] is None:
        return "-"
    middle, low, high = (100 * (found[name] or 0.0) for name in ("median", "q05", "q95"))
    return f"{middle:.0f} % ({low:.0f}-{high:.0f} %)"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"
