"""Checks of what all losses of constrained actors are told."""

from __future__ import annotations

from typing import Literal

from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.modules import has_density

Entropy = Literal["reference", "action"]
"""The entropy that is rewarded, see `cnfp_torchrl.objectives.ConstrainedSACLoss`."""


def require_discount(gamma: float) -> None:
    """Refuse a discount outside [0, 1).

    Raises:
        ValueError: naming it.
    """
    if not 0 <= gamma < 1:
        raise ValueError(f"gamma: expected a discount in [0, 1), given {gamma}")


def require_entropy(entropy: str, actor: SafeProbabilisticTensorDictSequential) -> None:
    """Refuse an unknown entropy, and one that an actor does not have.

    Raises:
        ValueError: naming it.
    """
    if entropy not in ("reference", "action"):
        raise ValueError(f"entropy: expected 'reference' or 'action', given {entropy!r}")
    if entropy == "action" and not has_density(actor):
        raise ValueError(
            "entropy: expected 'reference' for an actor whose actions have no density, such as "
            f"one that projects them, given {entropy!r}"
        )
