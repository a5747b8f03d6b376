"""What methods are called and how they look, in every figure and table."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Label:
    """A method as readers meet it.

    Args:
        name: The name for readers.
        color: The color as ``#RRGGBB``.
        marker: The marker of matplotlib; tells methods apart where colors do not.
        baseline: Whether it cares about the constraints in another way than the exact flow.
    """

    name: str
    color: str
    marker: str
    baseline: bool = False


# Colors of Okabe and Ito and grays of purple for the exact flow's two entropies; markers differ
# too, so that no method is told by its color alone.
LABELS = {
    "exact": Label("exact flow (ours)", "#4B2E83", "D"),
    "exact_action_entropy": Label("exact flow, entropy of the action", "#9B84CC", "d"),
    "gauge": Label("exact flow, boxes radial too", "#2C5985", "h"),
    "radial": Label("radial flow", "#56B4E9", "p"),
    "squash": Label("chain of squashes (the paper's)", "#CC79A7", "s", baseline=True),
    "projection": Label("projection", "#009E73", "^", baseline=True),
    "lagrangian": Label("SAC-Lagrangian", "#E69F00", "o", baseline=True),
    "lagrangian_threshold": Label("SAC-Lagrangian, small threshold", "#B2182B", "<", baseline=True),
    "penalty": Label("reward penalty", "#8C510A", "v", baseline=True),
    "unconstrained": Label("unconstrained", "#6E6E6E", "X"),
}
"""In the order in which they are shown."""

_SPARE = (("#2C5985", ">"), ("#7A8B00", "h"), ("#00686B", "P"), ("#A6761D", "8"))


def label(method: str) -> Label:
    """Return how a method is shown; a variant is of the kind of the method that its name begins."""
    if method in LABELS:
        return LABELS[method]
    family = max((name for name in LABELS if method.startswith(f"{name}_")), key=len, default=None)
    color, marker = _SPARE[sum(method.encode()) % len(_SPARE)]
    if family is None:
        return Label(method, color, marker, baseline=True)
    rest = method.removeprefix(f"{family}_").replace("_", " ")
    return Label(f"{LABELS[family].name}, {rest}", color, marker, LABELS[family].baseline)


def in_order(methods: Iterable[str]) -> list[str]:
    """Return methods in the order of `LABELS`, each variant after its family."""
    names = list(LABELS)

    def rank(method: str) -> tuple[int, str]:
        family = [i for i, name in enumerate(names) if f"{method}_".startswith(f"{name}_")]
        return (max(family, default=len(names)), method)

    return sorted(methods, key=rank)
