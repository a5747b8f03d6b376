"""What methods are called, what they are, and how they look, in every figure and table."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

from cnfp_torchrl.visual.comparison import Look


class Kind(Enum):
    """What a method does about the constraints."""

    EXACT = "exact by construction"
    CHAIN = "the paper's chain"
    PROJECTED = "projected"
    LEARNED = "learned"
    IGNORED = "ignored"


@dataclass(frozen=True)
class Label:
    """A method as readers meet it.

    Args:
        look: name, color and marker.
        kind: what it does about the constraints.
    """

    look: Look
    kind: Kind


# Colors of Okabe and Ito and grays of purple for the exact flow's two entropies; markers differ
# too, so that no method is told by its color alone.
LABELS = {
    "exact": Label(Look("exact flow (ours)", "#4B2E83", "D"), Kind.EXACT),
    "exact_action_entropy": Label(
        Look("exact flow, entropy of the action", "#9B84CC", "d"), Kind.EXACT
    ),
    "gauge": Label(Look("exact flow, boxes radial too", "#2C5985", "h"), Kind.EXACT),
    "radial": Label(Look("radial flow", "#56B4E9", "p"), Kind.EXACT),
    "squash": Label(Look("chain of squashes (the paper's)", "#CC79A7", "s"), Kind.CHAIN),
    "projection": Label(Look("projection", "#009E73", "^"), Kind.PROJECTED),
    "lagrangian": Label(Look("SAC-Lagrangian", "#E69F00", "o"), Kind.LEARNED),
    "lagrangian_threshold": Label(
        Look("SAC-Lagrangian, small threshold", "#B2182B", "<"), Kind.LEARNED
    ),
    "penalty": Label(Look("reward penalty", "#8C510A", "v"), Kind.LEARNED),
    "unconstrained": Label(Look("unconstrained", "#6E6E6E", "X"), Kind.IGNORED),
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
        return Label(Look(method, color, marker), Kind.LEARNED)
    rest = method.removeprefix(f"{family}_").replace("_", " ")
    known = LABELS[family]
    return Label(Look(f"{known.look.label}, {rest}", color, marker), known.kind)


def in_order(methods: Iterable[str]) -> list[str]:
    """Return methods in the order of `LABELS`, each variant after its family."""
    names = list(LABELS)

    def rank(method: str) -> tuple[int, str]:
        family = [i for i, name in enumerate(names) if f"{method}_".startswith(f"{name}_")]
        return (max(family, default=len(names)), method)

    return sorted(methods, key=rank)
