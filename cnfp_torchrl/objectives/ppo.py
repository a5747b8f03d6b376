"""Proximal policy optimization for constrained actors."""

from __future__ import annotations

from typing import Any

from tensordict.nn import TensorDictModule
from torchrl.modules import SafeProbabilisticTensorDictSequential
from torchrl.objectives import ClipPPOLoss, ValueEstimators

from cnfp_torchrl.modules import split_at_latent, with_reference_entropy
from cnfp_torchrl.objectives.requirements import Entropy, require_discount, require_entropy


class ConstrainedPPOLoss(ClipPPOLoss):
    """The clipped PPO loss of a constrained actor, whose ratios are those of stored latents.

    Transitions are collected with ``split_at_latent(actor_network).policy``, which stores latents
    and their log-densities; their ratios are exact, however saturated the actions
    (`cnfp_torchrl.modules.split_at_latent`). Advantages are computed by `value_estimator`, GAE.

    Args:
        actor_network: A constrained actor (`make_constrained_actor`, `constrain`).
        critic_network: A critic that reads the observation and writes ``state_value``.
        entropy: The entropy of the bonus, ``reference`` or ``action``; see `ConstrainedSACLoss`.
        gamma: The discount factor, in [0, 1).
        lmbda: The weight of longer returns in the advantages, in [0, 1].
        normalize_advantage: Whether advantages of a batch get mean 0 and deviation 1.
        kwargs: Further options of `torchrl.objectives.ClipPPOLoss`, such as ``clip_epsilon`` and
            ``entropy_coeff``.

    Raises:
        TypeError: when the actor is not a constrained one.
        ValueError: for an unknown entropy, for ``action`` where actions have no density, and for a
            discount or weight outside its range.
    """

    def __init__(
        self,
        actor_network: SafeProbabilisticTensorDictSequential,
        critic_network: TensorDictModule,
        *,
        entropy: Entropy = "reference",
        gamma: float = 0.99,
        lmbda: float = 0.95,
        normalize_advantage: bool = True,
        **kwargs: Any,
    ) -> None:
        require_entropy(entropy, actor_network)
        require_discount(gamma)
        if not 0 <= lmbda <= 1:
            raise ValueError(f"lmbda: expected a number in [0, 1], given {lmbda}")
        scored = with_reference_entropy(actor_network) if entropy == "reference" else actor_network
        super().__init__(
            split_at_latent(scored).base,
            critic_network,
            normalize_advantage=normalize_advantage,
            # Of a critic's first batches it is far below zero, and NaN where all returns are alike.
            log_explained_variance=False,
            **kwargs,
        )
        self.make_value_estimator(ValueEstimators.GAE, gamma=gamma, lmbda=lmbda)
