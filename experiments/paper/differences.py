"""Configurations of runs, compared setting by setting."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

ABSENT = "absent"


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """Return the settings in which two configurations differ, by dotted name, in both as JSON."""
    first, second = dict(_flat(one)), dict(_flat(other))
    names = sorted({*first, *second})
    pairs = {name: (first.get(name, ABSENT), second.get(name, ABSENT)) for name in names}
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}


def in_words(usual: Mapping[str, Any], special: Mapping[str, Any]) -> str:
    """Return, as Markdown, what is special about a configuration beside a usual one."""
    values = {name: value for name, (_, value) in differences(usual, special).items()}
    said = []
    for name, value in values.items():
        if value == ABSENT and any(each.startswith(f"{name}.") for each in values):
            continue
        what = name.removesuffix("._target_")
        if what != name and value != ABSENT:
            value = json.loads(value).rpartition(".")[2]
        said.append(f"`{what}: {value}`")
    return ", ".join(said) or "nothing"


def _flat(content: Any, prefix: str = "") -> Iterator[tuple[str, str]]:
    if not isinstance(content, Mapping) or not content:
        yield prefix, json.dumps(content)
        return
    for name, each in content.items():
        yield from _flat(each, f"{prefix}.{name}" if prefix else name)
