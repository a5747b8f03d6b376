"""Target networks that follow in one operation."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchrl.objectives import LossModule, SoftUpdate


class FusedSoftUpdate(SoftUpdate):
    """`torchrl.objectives.SoftUpdate` of all targets in one ``foreach`` operation, nothing else.

    Args:
        loss_module: the loss whose ``target_..._params`` follow its ``..._params``.
        kwargs: ``tau``, the share of the way that targets go in a step, or ``eps = 1 - tau``.
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
