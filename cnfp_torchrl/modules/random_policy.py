"""Random actions that satisfy the constraints: a policy, and a warm-up before a learned one."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.keys import LATENT_KEY
from cnfp_torchrl.modules.actors import flow_head
from cnfp_torchrl.modules.flow_module import ConstrainedFlowModule
from cnfp_torchrl.modules.latent import FlowMap


class SafeRandomPolicy(TensorDictModuleBase):
    """Push standard Gaussian noise through the flow: the safe counterpart of ``env.rand_action``.

    TorchRL's own random actions are uniform over the action spec and break constraints. Writes what
    the flow module writes, and location 0 and scale 1 where a network would write its own.

    Args:
        actor: A constrained actor; its networks are not called.

    Raises:
        TypeError: when the actor is not a constrained one.
    """

    def __init__(self, actor: SafeProbabilisticTensorDictSequential) -> None:
        super().__init__()
        self.head = head = flow_head(actor)
        self.in_keys = head.geometry_keys()
        self.out_keys = [*head.parameter_keys, *head.out_keys]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write an action for every batch element."""
        return self.head.random(tensordict)


class SafeRandomLatents(TensorDictModuleBase):
    """Draw latents of standard Gaussian noise, and write them beside the actions that they become.

    Args:
        head: The flow module of a constrained actor (`flow_head`).
        latent_key: The key of the latents ``(*batch, d)``.
    """

    def __init__(self, head: ConstrainedFlowModule, latent_key: NestedKey = LATENT_KEY) -> None:
        super().__init__()
        self.map = FlowMap(head, latent_key)
        self.in_keys = head.geometry_keys()
        self.out_keys = [latent_key, head.action_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write a latent and its action for every batch element."""
        head = self.map.head
        like = tensordict.get(self.in_keys[0]) if self.in_keys else head.bounds.low
        device = like.device if tensordict.device is None else tensordict.device
        shape = (*tensordict.shape, head.action_dim)
        latent = torch.randn(shape, dtype=head.action_dtype, device=device)
        return self.map(tensordict.set(self.map.latent_key, latent))


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
