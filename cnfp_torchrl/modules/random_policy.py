"""Random actions that satisfy the constraints, and random latents that become such."""

from __future__ import annotations

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
