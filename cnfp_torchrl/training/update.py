"""One step of learning: losses of a batch, their gradients, the optimizer, the targets."""

from __future__ import annotations

from functools import reduce

import torch
from tensordict import TensorDictBase
from torch import nn
from torch.optim import Optimizer
from torchrl.objectives import LossModule
from torchrl.objectives.utils import TargetNetUpdater


class UpdateBudget:
    """The number of updates that are due, which need not be whole.

    Args:
        ratio: Updates for each environment step.
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
        loss: The loss; its outputs named ``loss_...`` are summed and descended.
        optimizer: The optimizer of the loss's parameters.
        target: The updater of the loss's target networks, if it has any, called after each step.
        actor_every: The number of steps of the critics for one of actor and targets; more than 1
            needs a loss with a ``critic_loss`` of its own, such as `ConstrainedTD3Loss`.
        max_grad_norm: The largest norm of the gradient, which is shortened to it; None leaves it.
        compiled: Whether to compile the loss and its backward pass, which takes up to a minute,
            once, at the second step.
    """

    def __init__(
        self,
        loss: LossModule,
        optimizer: Optimizer,
        target: TargetNetUpdater | None = None,
        *,
        actor_every: int = 1,
        max_grad_norm: float | None = None,
        compiled: bool = False,
    ) -> None:
        self.loss = loss
        self.optimizer = optimizer
        self.target = target
        self.count = 0
        """The number of steps so far."""
        self._actor_every, self._max_grad_norm = actor_every, max_grad_norm
        self._losses, self._to_compile = loss, compiled

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Make one step and return what the loss returned."""
        self.count += 1
        is_whole = self.count % self._actor_every == 0
        losses = self._losses(batch) if is_whole else self.loss.critic_loss(batch)
        if is_whole and self._to_compile:
            # Not before the first step, at which losses make what they keep: it would be compiled
            # a second time.
            self._losses, self._to_compile = torch.compile(self.loss), False
        # Parameters without a gradient, such as the actor's in between, stay as they are.
        self.optimizer.zero_grad(set_to_none=True)
        parts = [value for name, value in losses.items() if name.startswith("loss_")]
        reduce(torch.add, parts).backward()
        if self._max_grad_norm is not None:
            nn.utils.clip_grad_norm_(self.loss.parameters(), self._max_grad_norm)
        self.optimizer.step()
        if self.target is not None and is_whole:
            self.target.step()
        return losses
