"""Other processors' rounding: numbers and results of operations a few units in the last place off.

Vector units, libraries and compilers round sums, quotients and elementary functions each in its own
way. What must hold on all of them is tested here on one, with errors as large as theirs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.overrides import resolve_name
from torch.utils._python_dispatch import TorchDispatchMode

OF_SEVERAL_STEPS = frozenset(
    {
        *("addcmul", "addcdiv", "lerp", "pow", "sum", "prod", "mean", "dot", "cumsum"),
        *("mm", "bmm", "addmm", "baddbmm", "linalg_vector_norm", "linalg_solve_triangular"),
        *("exp", "log", "log1p", "tanh", "atanh", "softplus"),
    }
)
"""ATen operations that IEEE 754 does not fix: sums, fused products, elementary functions."""

INEXACT = OF_SEVERAL_STEPS | {"add", "sub", "rsub", "mul", "div", "reciprocal", "sqrt"}
"""All that round; a compiler may fuse those that are fixed alone. Others move or choose numbers."""


def moved(value: Tensor, steps: int | Tensor) -> Tensor:
    """Return a tensor with each element moved up by some units in the last place, or down.

    What is 0 or subnormal moves by multiples of the smallest normal number.
    """
    tiny = torch.finfo(value.dtype).tiny
    bits = value.view(torch.int32 if value.dtype == torch.float32 else torch.int64)
    # Floating-point numbers of one sign are ordered like the integers of their bits.
    changed = (bits + torch.where(bits < 0, -1, 1) * steps).to(bits.dtype)
    return torch.where(value.abs() > 2 * tiny, changed.view(value.dtype), value + steps * tiny)


def moved_at_random(value: Tensor, most: int, random: torch.Generator) -> Tensor:
    """Return a tensor with each finite element moved by at most some units in the last place."""
    steps = torch.randint(-most, most + 1, value.shape, generator=random, dtype=torch.int32)
    return torch.where(value.isfinite(), moved(value, steps), value)


class RoundedOtherwise(TorchDispatchMode):
    """A processor on which each inexact result is off by at most some units in the last place.

    Args:
        most: How many units.
        seed: The seed of the errors; one computation done twice comes out differently.
        operations: Whose results are off.
    """

    def __init__(self, most: int = 1, seed: int = 0, operations: frozenset[str] = INEXACT) -> None:
        super().__init__()
        self._most = most
        self._operations = operations
        self._random = torch.Generator().manual_seed(seed)
        self.seen: set[str] = set()

    def __torch_dispatch__(
        self,
        func: Any,
        types: Sequence[type],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        name = str(resolve_name(func)).split(".")[1]
        if name.rstrip("_") not in self._operations or not isinstance(result, Tensor):
            return result
        if not result.is_floating_point():
            return result
        self.seen.add(name)
        changed = moved_at_random(result, self._most, self._random)
        return result.copy_(changed) if name.endswith("_") else changed
