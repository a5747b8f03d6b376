"""A folder of records: what can be compared, and what is wrong with the rest."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from experiments.paper.fields import RecordError
from experiments.paper.record import (
    MODES,
    PROCESSOR,
    RETURN,
    SECONDS,
    VIOLATIONS,
    Outcome,
    Record,
    Series,
    load_record,
)

__all__ = [
    "MODES",
    "PROCESSOR",
    "RETURN",
    "SECONDS",
    "VIOLATIONS",
    "Outcome",
    "Record",
    "RecordError",
    "Series",
    "load_record",
    "load_records",
]


def load_records(
    folder: Path, expected: Iterable[tuple[str, int]] = ()
) -> tuple[list[Record], list[str]]:
    """Read a folder of records; what is wrong is named and left out, never averaged.

    Runs of one method are comparable when only their seeds differ: of several configurations the
    most frequent is kept. A seed that one method has and another lacks is named too.

    Args:
        folder: of ``METHOD/seed_S.json`` files.
        expected: methods and seeds that should be there besides.

    Returns:
        the usable records by method and seed, and a sentence for each problem.
    """
    found, problems = [], []
    for path in sorted(folder.rglob("*") if folder.is_dir() else ()):
        if path.is_dir():
            continue
        try:
            record = load_record(path)
        except RecordError as error:
            problems.append(f"{error} (left out)")
            continue
        if record.path(folder) == path:
            found.append(record)
        else:
            problems.append(
                f"{path}: method, seed: expected a record of the run that the path names, given "
                f"{record.method!r}, seed {record.seed}: a copy or a misplaced file (left out)"
            )
    records, mixed = _alike(sorted(found, key=lambda r: (r.method, r.seed)))
    problems += mixed
    present = {(record.method, record.seed) for record in found}
    seeds = {record.seed for record in records}
    wanted = {(r.method, seed) for r in found for seed in seeds} | set(expected)
    problems += [f"{method}, seed {seed}: no record" for method, seed in sorted(wanted - present)]
    budgets = {record.method: record.steps for record in records}
    if len(set(budgets.values())) > 1:
        given = ", ".join(f"{method} {steps:,}" for method, steps in budgets.items())
        problems.append(f"steps: expected one budget for all methods, given {given}")
    return records, problems


def _alike(records: list[Record]) -> tuple[list[Record], list[str]]:
    settings = {id(record): _settings(record) for record in records}
    counts: dict[str, Counter[str]] = {}
    for record in records:
        counts.setdefault(record.method, Counter())[settings[id(record)]] += 1
    usual = {method: counter.most_common(1)[0][0] for method, counter in counts.items()}
    kept = [record for record in records if settings[id(record)] == usual[record.method]]
    problems = [
        f"{record.method}, seed {record.seed}: config: expected that of the method's other runs, "
        f"given another with {record.steps:,} steps and overrides {list(record.overrides)} "
        "(left out)"
        for record in records
        if settings[id(record)] != usual[record.method]
    ]
    return kept, problems


def _settings(record: Record) -> str:
    """Return what must agree between runs whose results are averaged."""
    config = {name: each for name, each in record.config.items() if name != "seed"}
    return json.dumps([record.steps, config], sort_keys=True)
