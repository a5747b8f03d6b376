"""One step of learning: losses of a batch, their gradients, the optimizer, the targets."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch.optim import Optimizer
from torchrl.objectives import LossModule
from torchrl.objectives.utils import TargetNetUpdater


class UpdateBudget:
    """The number of updates that are due, which need not be whole.

    Args:
        ratio: updates for each environment step.
    """

    def __init__(self, ratio: float) -> None:
        self._ratio = ratio
        self.due = 0.0
        """The number of updates that are due."""

    def earn(self, frames: int) -> None:
        """Add the updates of environment steps."""
        self.due += frames * self._ratio

    def spend(self) -> bool:
        """Take one update off, if a whole one is due, and tell whether it was."""
        if self.due < 1:
            return False
        self.due -= 1
        return True


class Update:
    """A step of learning from a batch of transitions.

    Args:
        loss: the loss; its outputs named ``loss_...`` are summed and descended.
        optimizer: optimizer of the loss's parameters.
        target: updater of the loss's target networks, called after each step.
        compiled: compile the loss and its backward pass, which takes a minute or more, once.
    """

    def __init__(
        self,
        loss: LossModule,
        optimizer: Optimizer,
        target: TargetNetUpdater,
        *,
        compiled: bool = False,
    ) -> None:
        self.loss = loss
        self.optimizer = optimizer
        self.target = target
        self._losses = torch.compile(loss) if compiled else loss

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Make one step and return what the loss returned."""
        losses = self._losses(batch)
        self.optimizer.zero_grad()
        sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
        self.optimizer.step()
        self.target.step()
        return losses
