"""What hostile networks did behind each flow, as kept by ``experiments/hostile_networks.py``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.paper.fields import Fields

KEPT = Path(__file__).parents[1] / "results" / "hostile_networks.json"


@dataclass(frozen=True)
class HostileRun:
    """One hostile network behind one flow.

    Args:
        flow: name of the flow's configuration.
        network: name of the network.
        steps: environment steps.
        violations: violating steps by constraint.
    """

    flow: str
    network: str
    steps: int
    violations: dict[str, int]


def load_hostile(path: Path) -> list[HostileRun]:
    """Read the kept result; each row's other entries are left alone.

    Raises:
        RecordError: when the file is missing or of another form, naming it and the field.
    """
    fields = Fields.read(path)
    rows = fields.take("rows")
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows) or not rows:
        raise fields.error("rows", "expected a list of one object or more")
    runs = []
    for i, row in enumerate(rows):
        each = Fields(path, f"rows[{i}]", row)
        runs.append(
            HostileRun(
                each.text("flow"), each.text("network"), each.whole("steps"),
                each.counts("violations"),
            )
        )  # fmt: skip
    return runs


def by_flow(runs: Sequence[HostileRun]) -> dict[str, list[HostileRun]]:
    """Return the runs of each flow, in the order in which flows first appear."""
    grouped: dict[str, list[HostileRun]] = {}
    for run in runs:
        grouped.setdefault(run.flow, []).append(run)
    return grouped
