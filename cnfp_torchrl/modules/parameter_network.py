"""The network of an actor as a TensorDictModule that costs no more than the network."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, skip_existing
from tensordict.utils import NestedKey
from torch import Tensor


class ParameterNetwork(TensorDictModule):
    """A `tensordict.nn.TensorDictModule` whose network returns tensors, which it writes directly.

    tensordict 0.14 looks on disk for pandas at each entry that its module writes, lest it be a data
    frame, which takes longer than a small network does. Whatever is not the usual call is left to
    it: tensors in place of a tensordict, missing entries, other outputs than the keys say.

    Args:
        network: The network, which returns a tensor or a tuple of them.
        in_keys: The keys of what it reads.
        out_keys: The keys of what it returns.
    """

    def __init__(
        self,
        network: Callable[..., Tensor | tuple[Tensor, ...]],
        in_keys: Sequence[NestedKey],
        out_keys: Sequence[NestedKey],
    ) -> None:
        super().__init__(network, in_keys=list(in_keys), out_keys=list(out_keys))

    def forward(
        self, tensordict: TensorDictBase, *args: Any, **kwargs: Any
    ) -> TensorDictBase | tuple[Tensor, ...]:
        """Write the network's outputs."""
        usual = isinstance(tensordict, TensorDictBase) and not (args or kwargs)
        if not usual or torch.compiler.is_compiling() or skip_existing():
            return super().forward(tensordict, *args, **kwargs)
        inputs = [tensordict.get(key, None) for key in self.in_keys]
        if any(value is None for value in inputs):
            return super().forward(tensordict)
        outputs = self.module(*inputs)
        outputs = outputs if isinstance(outputs, tuple) else (outputs,)
        if len(outputs) != len(self.out_keys) or not all(isinstance(o, Tensor) for o in outputs):
            return super().forward(tensordict)
        for key, value in zip(self.out_keys, outputs, strict=True):
            tensordict.set(key, value)
        return tensordict
