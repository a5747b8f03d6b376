"""Twin delayed deterministic policy gradients for constrained actors."""

from __future__ import annotations

import math
from typing import Any

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential, dispatch
from torch import nn
from torchrl.modules import SafeProbabilisticTensorDictSequential
from torchrl.objectives import TD3Loss, ValueEstimators

from cnfp_torchrl.keys import LATENT_KEY
from cnfp_torchrl.modules import FlowMap, actor_modules, flow_head
from cnfp_torchrl.objectives.requirements import require_discount


class ConstrainedTD3Loss(TD3Loss):
    """The TD3 loss of a constrained actor, whose noise is added to the latent, before the flow.

    To it, the latent is the action and the flow the first layer of the critic, so that the noise
    that smooths the targets is carried to allowed actions. The policy is the location of the
    actor's Gaussian; exploration is the Gaussian itself, whose scale is not learned
    (`cnfp_torchrl.training.networks.deterministic_network`). Transitions are collected with
    ``split_at_latent(actor_network).policy``, which stores the latents.

    Args:
        actor_network: A constrained actor (`make_constrained_actor`, `constrain`).
        qvalue_network: A critic that reads observation and action and writes
            ``state_action_value``.
        gamma: The discount factor, in [0, 1).
        kwargs: Further options of `torchrl.objectives.TD3Loss`, such as ``policy_noise`` and
            ``noise_clip``, in units of the latent.

    Raises:
        TypeError: when the actor is not a constrained one.
        ValueError: for a discount outside [0, 1).
    """

    def __init__(
        self,
        actor_network: SafeProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule,
        *,
        gamma: float = 0.99,
        **kwargs: Any,
    ) -> None:
        require_discount(gamma)
        head = flow_head(actor_network)
        location = TensorDictModule(nn.Identity(), head.parameter_keys[:1], [LATENT_KEY])
        flow = FlowMap(head)
        super().__init__(
            # With the flow, for its keys: what the actor does not read is not there for the critic.
            TensorDictSequential(*actor_modules(actor_network)[:-1], location, flow),
            TensorDictSequential(flow, qvalue_network),
            bounds=(-math.inf, math.inf),
            **kwargs,
        )
        self.set_keys(action=LATENT_KEY)
        self.make_value_estimator(ValueEstimators.TD0, gamma=gamma)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return ``loss_actor`` and ``loss_qvalue``."""
        losses = super().forward(tensordict)
        return TensorDict({name: losses[name] for name in ("loss_actor", "loss_qvalue")}, [])

    def critic_loss(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return ``loss_qvalue`` alone, for the updates between two of the actor."""
        return TensorDict({"loss_qvalue": self.value_loss(tensordict)[0]}, [])
