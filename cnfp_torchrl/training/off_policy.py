"""Algorithms that learn from stored transitions: SAC, TD3."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.keys import COST_KEY, LATENT_KEY
from cnfp_torchrl.modules import SafeRandomLatents, WarmUpPolicy, flow_head, split_at_latent
from cnfp_torchrl.training.agent import build_loss
from cnfp_torchrl.training.checkpoints import Attributes, Stateful
from cnfp_torchrl.training.settings import TrainingSettings
from cnfp_torchrl.training.storage import prepare_buffer
from cnfp_torchrl.training.stored_transitions import StoredTransitions
from cnfp_torchrl.training.update import Update, UpdateBudget


class OffPolicyLearner:
    """Store all transitions, act at random first, and learn from random batches.

    Args:
        config: The configuration of the run.
        env: The environment of training.
        actor: The actor to train.
        states: The folder of the transitions that a resumed run needs; None keeps none.
        actor_every: The number of updates of the critics for one of the actor and the targets.

    Raises:
        ValueError: for a loss of another kind of algorithm.
    """

    def __init__(
        self,
        config: DictConfig,
        env: TransformedEnv,
        actor: SafeProbabilisticTensorDictSequential,
        states: Path | None,
        *,
        actor_every: int = 1,
    ) -> None:
        self._settings: TrainingSettings = instantiate(config.training)
        self.loss = build_loss(config, env, actor)
        self._require_loss(actor_every)
        self.optimizer = instantiate(config.optim, _partial_=True)(self.loss.parameters())
        self._update = Update(
            self.loss,
            self.optimizer,
            instantiate(config.target, _partial_=True)(self.loss),
            actor_every=actor_every,
            compiled=config.compile,
        )
        self.policy = self._exploring(actor, compiled=config.compile)
        self._buffer = instantiate(config.replay_buffer)
        others = [("next", COST_KEY), LATENT_KEY]
        self._stored = prepare_buffer(
            self._buffer,
            env,
            actor.in_keys,
            other_keys=[key for key in others if key in self.loss.in_keys],
            constraint_bytes=self._settings.constraint_bytes,
        )
        folder = Path() if states is None else states
        self.transitions = StoredTransitions(self._buffer, folder, is_saved=states is not None)
        self._budget = UpdateBudget(self._settings.update_ratio)

    def _require_loss(self, actor_every: int) -> None:
        name = type(self.loss).__name__
        if hasattr(self.loss.tensor_keys, "advantage"):
            raise ValueError(
                f"loss: expected one that learns from stored transitions, given {name}; take "
                "algorithm=ppo"
            )
        if actor_every > 1 and not hasattr(self.loss, "critic_loss"):
            raise ValueError(
                f"algorithm.actor_every: expected 1 for a loss without a critic_loss of its own, "
                f"given {actor_every} and {name}; take loss=td3"
            )

    def _exploring(
        self, actor: SafeProbabilisticTensorDictSequential, *, compiled: bool
    ) -> WarmUpPolicy:
        """Return the policy of training, which writes the latent where the loss reads it."""
        frames = self._settings.warmup_frames
        if LATENT_KEY in self.loss.in_keys:
            random = SafeRandomLatents(flow_head(actor))
            policy = WarmUpPolicy(split_at_latent(actor).policy, frames, random)
        else:
            policy = WarmUpPolicy(actor, frames)
        if compiled:
            # Not the policy around it, which counts: a number that changes would be compiled anew.
            policy.actor = torch.compile(policy.actor)
        return policy

    def begin(self) -> None:
        """Begin the warm-up anew."""
        self.policy.frames_left = self._settings.warmup_frames

    def learn(self, collected: TensorDictBase, frames: int) -> Iterator[TensorDictBase]:
        """Store the transitions, and make the updates that are due once the warm-up is over."""
        batch = collected.reshape(-1)
        self.transitions.extend(batch.select(*self._stored))
        if frames >= self._settings.warmup_frames:
            self._budget.earn(batch.numel())
            while self._budget.spend():
                yield self._update(self._buffer.sample())

    def components(self) -> dict[str, Stateful]:
        """Return the warm-up, the updates that are due, and their number."""
        return {
            "warm_up": Attributes(self.policy, "frames_left"),
            "budget": Attributes(self._budget, "due"),
            "updates": Attributes(self._update, "count"),
        }
