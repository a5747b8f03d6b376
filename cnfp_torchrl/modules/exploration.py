"""The refusal of exploration modules that would break constraints."""

from __future__ import annotations

from torch import nn
from torchrl.modules import (
    AdditiveGaussianModule,
    EGreedyModule,
    OrnsteinUhlenbeckProcessModule,
)

from cnfp_torchrl.modules.flow_module import ConstrainedFlowModule

EXPLORATION = (AdditiveGaussianModule, EGreedyModule, OrnsteinUhlenbeckProcessModule)
"""TorchRL's modules that change an action after a policy has chosen it."""


def refuse_exploration(policy: nn.Module) -> None:
    """Refuse a policy in which one of TorchRL's exploration modules changes constrained actions.

    Such noise respects the action bounds, not the constraints. On the latent, before a `FlowMap`,
    it is mapped to allowed actions and is accepted.

    Args:
        policy: A policy, such as a sequence of a constrained actor and further modules.

    Raises:
        TypeError: naming the exploration module and what to do.
    """
    actions = [
        module.action_key
        for module in policy.modules()
        if isinstance(module, ConstrainedFlowModule)
    ]
    for module in policy.modules():
        if isinstance(module, EXPLORATION) and any(key in actions for key in module.out_keys):
            raise TypeError(
                f"policy: expected no {type(module).__name__} on constrained actions, which its "
                "noise would take out of their sets; a flow explores by its own Gaussian, and "
                "noise of other kinds belongs on the latent, before a FlowMap"
            )
