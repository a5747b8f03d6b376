"""Soft actor-critic for constrained actors."""

from __future__ import annotations

from typing import Any, Literal

from tensordict.nn import TensorDictModule
from torchrl.modules import SafeProbabilisticTensorDictSequential
from torchrl.objectives import ValueEstimators

from cnfp_torchrl.modules import has_density, with_reference_entropy
from cnfp_torchrl.objectives.batched_sac import BatchedSACLoss

Entropy = Literal["reference", "action"]


class ConstrainedSACLoss(BatchedSACLoss):
    r"""TorchRL's SAC loss with a choice of the entropy that is rewarded.

    ``action`` takes :math:`-\log\pi(a|s)`, the entropy of the action itself. ``reference`` leaves
    the retractions' log-determinants out: the entropy in the coordinates of the action bounds, for
    which the usual target -d is right however small the allowed region (see
    `cnfp_torchrl.distributions.ReferenceEntropyFlow`). The policy and its actions are the same;
    only the bonus differs.

    Args:
        actor_network: a constrained actor (`make_constrained_actor`, `constrain`).
        qvalue_network: reads observation and action, writes ``state_action_value``.
        entropy: ``reference`` or ``action``.
        gamma: discount factor, in [0, 1).
        kwargs: passed on to `BatchedSACLoss`, which takes those of `torchrl.objectives.SACLoss`.

    Raises:
        ValueError: for an unknown entropy, for ``action`` where actions have no density, and for a
            discount outside [0, 1).
    """

    def __init__(
        self,
        actor_network: SafeProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule,
        *,
        entropy: Entropy = "reference",
        gamma: float = 0.99,
        **kwargs: Any,
    ) -> None:
        if entropy not in ("reference", "action"):
            raise ValueError(f"entropy: expected 'reference' or 'action', given {entropy!r}")
        if not 0 <= gamma < 1:
            raise ValueError(f"gamma: expected a discount in [0, 1), given {gamma}")
        if entropy == "action" and not has_density(actor_network):
            raise ValueError(
                "entropy: expected 'reference' for an actor whose actions have no density, such as "
                f"one that projects them, given {entropy!r}"
            )
        scored = with_reference_entropy(actor_network) if entropy == "reference" else actor_network
        super().__init__(scored, qvalue_network, **kwargs)
        self.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
