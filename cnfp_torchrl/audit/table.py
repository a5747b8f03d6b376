"""An audit's report as text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # the report is told by this module
    from cnfp_torchrl.audit.report import AuditReport, Findings, Quantiles, Share

_HEADER = (
    "states",
    "constraint",
    "unsound",
    "escaped",
    "dead ends",
    "coverage",
    "where it binds",
    "dropped",
    "though possible",
    "volume, median (5-95 %)",
    "anchor slack, median (least)",
)

_LEGEND = """\
unsound: actions inside the active set that the environment's indicator calls violations
escaped: samples of the flow outside the active set
dead ends: allowed actions after which the constraint must be dropped
coverage: share of the actions allowed by the indicators, one step ahead, that the set lets the flow
  reach, with a 95 % interval over states; where it binds: in states where the set leaves some out.
  Below 100 % is no flaw where a set plans further ahead than one step
dropped: states in which the constraint is not active, because it cannot hold or yields to others;
  though possible: some action there keeps its indicator for one step"""


def as_text(report: AuditReport) -> str:
    """Return tables, notes, examples and the verdict."""
    return "\n\n".join(_parts(report))


def _parts(report: AuditReport) -> Iterator[str]:
    subject = report.subject
    yield (
        f"{subject['environment']}, {subject['flow']}, order {' < '.join(report.order)}; states of "
        f"{' and '.join(report.sources)}, policy: {subject['policy']}"
    )
    rows: list[Sequence[str]] = [_HEADER]
    for source, found in report.sources.items():
        rows += [(source, *_row(each)) for each in found]
    yield _aligned(rows)
    yield _LEGEND
    done = report.executed
    rows = [("executed", "violations", "after the constraint had held")]
    for name, count in done.violations.items():
        rows.append((name, str(count), str(done.led_into.get(name, "no geometry"))))
    yield f"{_aligned(rows)}\nin {done.steps} steps of the policy"
    if report.notes:
        yield "\n".join(f"note: {note}" for note in report.notes)
    yield from _examples(report)
    flaws = report.flaws
    yield "\n".join(f"FLAW: {flaw}" for flaw in flaws) if flaws else "no flaw found"


def _row(found: Findings) -> tuple[str, ...]:
    slack = found.slack
    return (
        found.name,
        _count(found.unsound),
        _count(found.escaped),
        _count(found.dead_ends),
        _percent(found.coverage, interval=True),
        _percent(found.binding),
        _percent(found.dropped),
        _percent(found.possible),
        _spread(found.volume),
        f"{_number(slack['median'])} ({_number(slack['min'])})",
    )


def _examples(report: AuditReport) -> Iterator[str]:
    """Yield the worst example of each kind of flaw, with the state it fails in."""
    for source, findings in report.sources.items():
        for kind in ("unsound", "escaped", "dead_ends"):
            *single, together = findings
            # Those of all together are shown where they are no constraint's own.
            shown = [found for found in single if found.examples[kind]] or [together]
            for found in shown:
                for example in found.examples[kind][:1]:
                    name = kind.replace("_", " ")
                    yield _told(f"{found.name}, {source}, worst of {name}", example)
    for name, examples in report.executed.examples.items():
        for example in examples[:1]:
            yield _told(f"{name}, rollouts, the last state in which it held", example)


def _told(title: str, example: dict[str, Any]) -> str:
    lines = [f"{key}: {_short(value)}" for key, value in example.items() if key != "sets"]
    lines += [f"set of {name}: {_short(fields)}" for name, fields in example["sets"].items()]
    return f"{title}\n" + "\n".join(f"  {line}" for line in lines)


def _short(value: Any) -> str:
    """Return a plain value with numbers to six digits; the JSON file has all of them."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {_short(each)}" for name, each in value.items())
    if isinstance(value, list):
        return f"[{', '.join(_short(each) for each in value)}]"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _count(share: Share | None) -> str:
    if share is None:
        return "not judged"
    return f"{share.count} of {share.of}"


def _percent(share: Share | None, *, interval: bool = False) -> str:
    if share is None:
        return "not judged"
    if share.share is None:
        return "-"
    told = f"{100 * share.share:.1f} %"
    return f"{told} [{100 * share.low:.1f}, {100 * share.high:.1f}]" if interval else told


def _spread(found: Quantiles) -> str:
    if found["median"] is None:
        return "-"
    middle, low, high = (100 * (found[name] or 0.0) for name in ("median", "q05", "q95"))
    return f"{middle:.0f} % ({low:.0f}-{high:.0f} %)"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _aligned(rows: Sequence[Sequence[str]]) -> str:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) for row in rows]
    return "\n".join(line.rstrip() for line in lines)
