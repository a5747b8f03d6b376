"""Random actions that satisfy the constraints: a policy, and a warm-up before a learned one."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.modules.actors import flow_head


class SafeRandomPolicy(TensorDictModuleBase):
    """Push standard Gaussian noise through the flow: the safe counterpart of ``env.rand_action``.

    TorchRL's own random actions are uniform over the action spec and break constraints. Writes what
    the flow module writes, and location 0 and scale 1 where a network would write its own.

    Args:
        actor: a constrained one; its networks are not asked.

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


class WarmUpPolicy(TensorDictModuleBase):
    """Act at random, within the constraints, for a number of frames, then with the actor.

    Takes the place of a collector's ``init_random_frames``, whose actions are not constrained. A
    collector tries its policy once when it is made, which counts as one action of each batch
    element; to begin anew, set ``frames_left``. Each process of a distributed collector counts
    alone.

    Args:
        actor: a constrained actor.
        frames: number of actions, over all batch elements, before the actor takes over.
    """

    def __init__(self, actor: SafeProbabilisticTensorDictSequential, frames: int) -> None:
        super().__init__()
        if frames < 0:
            raise ValueError(f"frames: expected a number >= 0, given {frames}")
        self.actor = actor
        self.random = SafeRandomPolicy(actor)
        self.frames_left = frames
        self.in_keys, self.out_keys = actor.in_keys, actor.out_keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action of the policy whose turn it is."""
        if self.frames_left > 0:
            self.frames_left -= max(tensordict.numel(), 1)
            # The actor runs too, for keys of its own besides the Gaussian's parameters: every step
            # must carry the same ones.
            self.actor(tensordict)
            return self.random(tensordict)
        return self.actor(tensordict)
