"""Algorithms that learn from what their newest policy did, and forget it: PPO."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.modules import split_at_latent
from cnfp_torchrl.training.agent import build_loss
from cnfp_torchrl.training.checkpoints import Stateful
from cnfp_torchrl.training.update import Update


class OnPolicyLearner:
    """Learn from each batch of transitions several times, in random parts.

    Args:
        config: The configuration of the run.
        env: The environment of training.
        actor: The actor to train.
        states: The folder of what a resumed run needs, of which there is nothing.
        epochs: The number of times that each transition is learned from.
        minibatch: The number of transitions of an update.
        max_grad_norm: The largest norm of an update's gradient; longer ones are shortened to it.

    Raises:
        ValueError: for a loss that reads no advantages.
    """

    def __init__(
        self,
        config: DictConfig,
        env: TransformedEnv,
        actor: SafeProbabilisticTensorDictSequential,
        states: Path | None,
        *,
        epochs: int = 10,
        minibatch: int = 256,
        max_grad_norm: float = 1.0,
    ) -> None:
        self.loss = build_loss(config, env, actor)
        if not hasattr(self.loss.tensor_keys, "advantage"):
            raise ValueError(
                "loss: expected one that reads advantages, such as that of loss=ppo, given "
                f"{type(self.loss).__name__}; leave out algorithm=ppo"
            )
        self.optimizer = instantiate(config.optim, _partial_=True)(self.loss.parameters())
        self._update = Update(
            self.loss, self.optimizer, max_grad_norm=max_grad_norm, compiled=config.compile
        )
        policy = split_at_latent(actor).policy
        self.policy = torch.compile(policy) if config.compile else policy
        self.transitions = None
        self._epochs, self._minibatch = epochs, minibatch

    def begin(self) -> None:
        """Do nothing: there is no warm-up."""

    def learn(self, collected: TensorDictBase, frames: int) -> Iterator[TensorDictBase]:
        """Estimate advantages, and make all updates of these transitions."""
        with torch.no_grad():
            estimated = self.loss.value_estimator(collected.copy())
        read = [*self.loss.in_keys, self.loss.tensor_keys.advantage]
        steps = estimated.reshape(-1).select(*read, self.loss.tensor_keys.value_target)
        for _ in range(self._epochs):
            for part in torch.randperm(len(steps)).split(self._minibatch):
                yield self._update(steps[part])

    def components(self) -> dict[str, Stateful]:
        """Return nothing: it all begins anew with the next transitions."""
        return {}
