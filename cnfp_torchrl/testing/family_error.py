"""The error that says which method of a family of sets breaks the contract, and where."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor

from cnfp_torchrl.geometry import ConstraintSet

T = TypeVar("T")

_LONGEST = 16
"""How many numbers of a tensor a message shows."""


class FamilyError(AssertionError):
    """A family of sets that breaks the contract of `ConstraintSet`.

    Args:
        family: The class of the sets.
        method: The name of the method that is wrong, or ``"event_dims"``.
        problem: The sentence with the expected, the given, and where.
    """

    def __init__(self, family: type[ConstraintSet], method: str, problem: str) -> None:
        super().__init__(f"{family.__name__}.{method}: {problem}")
        self.family, self.method = family, method


def require(
    sets: ConstraintSet,
    method: str,
    holds: Tensor,
    expected: str,
    quantity: str,
    given: Tensor,
    **at: Tensor,
) -> None:
    """Raise an error about the first case in which something does not hold.

    Args:
        sets: Sets of batch shape ``(B,)``.
        method: The name of the method that is wrong where something does not hold.
        holds: Flags, boolean ``(*sample, B)``.
        expected: The wording of what should hold.
        quantity: The wording of the values given.
        given: Values to show beside the expected, ``(*sample, B)``.
        at: Names and values of the points concerned, ``(*sample, B, d)`` or broadcasting to it.

    Raises:
        FamilyError: naming the batch element with its fields, and where it fails.
    """
    if bool(holds.all()):
        return
    failing = (~holds).nonzero()
    index = tuple(int(i) for i in failing[0])
    element = sets.select(holds.shape[-1:], torch.tensor([index[-1]], device=holds.device))
    parts = {name: field[0] for name, field in element.fields().items()}
    parts |= {name: value.expand(*holds.shape, -1)[index] for name, value in at.items()}
    where = "".join(f"\n    {name} = {shown(value)}" for name, value in parts.items())
    raise FamilyError(
        type(sets),
        method,
        f"expected {expected}, given {quantity} {shown(given.expand(holds.shape)[index])}, in "
        f"{len(failing)} of {holds.numel()} cases ({sets.dtype}), the first in element {index[-1]} "
        f"of the flattened batch:{where}",
    )


def called(family: type[ConstraintSet], method: str, call: Callable[[], T]) -> T:
    """Return what a call returns, with its exceptions turned into an error that names the method.

    Raises:
        FamilyError: naming the method, from what it raised.
    """
    try:
        return call()
    except Exception as error:
        raise FamilyError(
            family, method, f"expected a result, given {type(error).__name__}: {error}"
        ) from error


def shown(value: Tensor) -> str:
    """Return a tensor as text, of its first numbers where there are many."""
    numbers = [f"{number:.9g}" for number in value.detach().flatten()[:_LONGEST].tolist()]
    if value.ndim == 0:
        return numbers[0]
    more = ", ..." if value.numel() > _LONGEST else ""
    shape = f" of shape {tuple(value.shape)}" if value.ndim > 1 or more else ""
    return f"[{', '.join(numbers)}{more}]{shape}"
