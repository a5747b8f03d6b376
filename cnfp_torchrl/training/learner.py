"""What an algorithm does with the transitions that are collected."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Protocol

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch.optim import Optimizer
from torchrl.objectives import LossModule

from cnfp_torchrl.training.checkpoints import Stateful
from cnfp_torchrl.training.stored_transitions import StoredTransitions


class Learner(Protocol):
    """An algorithm: the policy that collects, and updates from what it has collected."""

    policy: TensorDictModuleBase
    """The policy that acts in training; its networks are the actor's own."""

    loss: LossModule
    optimizer: Optimizer

    transitions: StoredTransitions | None
    """The transitions that later updates draw from, if there are any."""

    def begin(self) -> None:
        """Start anew when the collector has been made, which tries the policy once."""
        ...

    def learn(self, collected: TensorDictBase, frames: int) -> Iterator[TensorDictBase]:
        """Make the updates that are due, and yield the losses of each.

        Args:
            collected: Transitions ``(*environments, time)``.
            frames: The number of environment steps so far, with these.
        """
        ...

    def components(self) -> Mapping[str, Stateful]:
        """Return what else has a state from one batch of transitions to the next, by name."""
        ...
