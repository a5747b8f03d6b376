"""The soft update of all target networks in one operation."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchrl.objectives import LossModule, SoftUpdate


class FusedSoftUpdate(SoftUpdate):
    """A `torchrl.objectives.SoftUpdate` that moves all targets in one ``foreach`` operation.

    Args:
        loss_module: The loss whose ``target_..._params`` follow its ``..._params``.
        kwargs: The rate ``tau`` by which targets move to the parameters, or ``eps = 1 - tau``.
    """

    def __init__(self, loss_module: LossModule, **kwargs: Any) -> None:
        super().__init__(loss_module, **kwargs)
        pairs = [
            (self._targets[f"target_{name}", *rest], source)
            for (name, *rest), source in self._sources.items(True, True)
        ]
        # The tensors themselves, which stay the same when the loss is moved or loaded.
        self._pairs: tuple[tuple[Tensor, ...], ...] = tuple(zip(*pairs, strict=True))

    @torch.no_grad()
    def step(self) -> None:
        """Move the targets towards the parameters that they follow."""
        targets, sources = self._pairs
        torch._foreach_lerp_(targets, sources, 1 - self.eps)
