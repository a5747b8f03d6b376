"""A policy that acts at random for a number of frames, counted, before a learned one takes over."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from cnfp_torchrl.modules.random_policy import SafeRandomPolicy


class WarmUpPolicy(TensorDictModuleBase):
    """Act at random, within the constraints, for a number of frames, then with the actor.

    Takes the place of a collector's ``init_random_frames``, whose actions are not constrained. A
    collector tries its policy once when it is made, which counts as one action of each batch
    element; to begin anew, set ``frames_left``. Each process of a distributed collector counts
    alone.

    Args:
        actor: A constrained actor.
        frames: The number of actions, over all batch elements, before the actor takes over.
        random: The random policy; None takes ``SafeRandomPolicy(actor)``. A policy of
            `split_at_latent` needs ``SafeRandomLatents(flow_head(ACTOR))``.
    """

    def __init__(
        self,
        actor: TensorDictModuleBase,
        frames: int,
        random: TensorDictModuleBase | None = None,
    ) -> None:
        super().__init__()
        if frames < 0:
            raise ValueError(f"frames: expected a number >= 0, given {frames}")
        self.actor = actor
        self.random = SafeRandomPolicy(actor) if random is None else random
        # Not an int, for each value of which a compiled policy would be compiled anew. On the host,
        # where reading it does not wait for an accelerator.
        self._frames_left = torch.tensor(frames)
        self.in_keys, self.out_keys = actor.in_keys, actor.out_keys

    @property
    def frames_left(self) -> int:
        """The number of random actions to come."""
        return max(int(self._frames_left), 0)

    @frames_left.setter
    def frames_left(self, frames: int) -> None:
        self._frames_left = torch.tensor(frames)

    def __getstate__(self) -> dict[str, Any]:
        # A tensor would be shared by the processes to which the policy is sent.
        return {**super().__getstate__(), "_frames_left": int(self._frames_left)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__({**state, "_frames_left": torch.tensor(state["_frames_left"])})

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write a random action while frames are left, then the actor's."""
        if self._frames_left > 0:
            self._frames_left -= max(tensordict.numel(), 1)
            # The actor runs too, for entries that it alone writes: all steps must have the same.
            self.actor(tensordict)
            return self.random(tensordict)
        return self.actor(tensordict)
