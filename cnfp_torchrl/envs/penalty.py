"""The penalty transform, which replaces the reward of violations."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

from cnfp_torchrl.keys import COST_KEY, RAW_REWARD_KEY, REWARD_KEY


class RewardPenalty(Transform):
    r"""Replace the reward by a constant whenever a constraint is violated.

    .. math:: r' = -p \text{ if } \max_k c_k > 0, \text{ else } r

    The second baseline of Rietz et al. 2024 (arXiv 2405.01198), with p = 100: the agent is told of
    the constraints by its reward alone. The environment's own reward, by which returns are judged,
    stays at ``raw_reward`` under ``next`` (zero after a reset): append a `RewardSum` before this
    transform, and evaluate without it.

    Args:
        penalty: The penalty p; 0 is none and leaves the reward as it is.

    Raises:
        ValueError: for a penalty that is negative or not finite, and for an environment without
            ``cost``.
    """

    def __init__(self, penalty: float = 100.0) -> None:
        if not 0 <= penalty < math.inf:
            raise ValueError(f"penalty: expected a number >= 0, given {penalty}")
        super().__init__(in_keys=[REWARD_KEY, COST_KEY], out_keys=[REWARD_KEY, RAW_REWARD_KEY])
        self.penalty = float(penalty)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        if observation_spec.get(COST_KEY, None) is None:
            raise ValueError(
                f"RewardPenalty: expected an environment that publishes {COST_KEY!r}, given one "
                f"with {sorted(map(str, observation_spec.keys()))}; append a ConstraintCost first"
            )
        # Not in the reward spec: losses and collectors expect a single reward there.
        observation_spec[RAW_REWARD_KEY] = self._unbounded(self.parent.full_reward_spec)
        return observation_spec

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        reward_spec[REWARD_KEY] = self._unbounded(reward_spec)
        return reward_spec

    def _unbounded(self, reward_spec: Composite) -> Unbounded:
        spec = reward_spec[REWARD_KEY]
        return Unbounded(spec.shape, device=spec.device, dtype=spec.dtype)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        raw = next_tensordict.get(REWARD_KEY)
        violated = (next_tensordict.get(COST_KEY) > 0).any(-1, keepdim=True)
        next_tensordict.set(RAW_REWARD_KEY, raw)
        if self.penalty == 0:
            return next_tensordict
        punished = torch.full_like(raw, -self.penalty)
        return next_tensordict.set(REWARD_KEY, torch.where(violated, punished, raw))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # Where only some agents are reset, the caller merges.
        return tensordict_reset.set(
            RAW_REWARD_KEY, self.container.observation_spec[RAW_REWARD_KEY].zero()
        )
