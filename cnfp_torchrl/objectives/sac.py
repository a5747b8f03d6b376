"""Soft actor-critic for constrained actors."""

from __future__ import annotations

from typing import Any, Literal

from tensordict.nn import TensorDictModule
from torchrl.modules import SafeProbabilisticTensorDictSequential
from torchrl.objectives import ValueEstimators

from cnfp_torchrl.geometry import Box
from cnfp_torchrl.modules import (
    ConstrainedFlowModule,
    actor_modules,
    with_reference_entropy,
)
from cnfp_torchrl.objectives.batched_sac import BatchedSACLoss
from cnfp_torchrl.objectives.requirements import Entropy, require_discount, require_entropy


class ConstrainedSACLoss(BatchedSACLoss):
    r"""The SAC loss of a constrained actor, with a choice of the entropy that is rewarded.

    ``action`` takes :math:`-\log\pi(a|s)`, the entropy of the action itself. ``reference`` leaves
    the retractions' log-determinants out: the entropy in the coordinates of the action bounds, for
    which the usual target -d is right however small the allowed region (see
    `cnfp_torchrl.distributions.ReferenceEntropyFlow`). The policy and its actions are the same;
    only the bonus differs.

    Args:
        actor_network: A constrained actor (`make_constrained_actor`, `constrain`).
        qvalue_network: A critic that reads observation and action and writes
            ``state_action_value``.
        entropy: The entropy that is rewarded, ``reference`` or ``action``.
        gamma: The discount factor, in [0, 1).
        max_alpha: The largest weight of the entropy. Where a constraint is relaxed, the allowed
            region is as thin as the leeway, and no policy has the target entropy of its actions
            there: the weight would grow without end, and the gradients with it.
        target_entropy: The entropy that its weight is adapted to, in nats. ``auto`` takes
            `usual_target_entropy` of the action bounds: the reference entropy can have it whatever
            the flow and however small the allowed region, the action's entropy cannot.
        kwargs: Further options of `torchrl.objectives.SACLoss`.

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
        max_alpha: float = 10.0,
        target_entropy: float | Literal["auto"] = "auto",
        **kwargs: Any,
    ) -> None:
        require_entropy(entropy, actor_network)
        require_discount(gamma)
        scored = with_reference_entropy(actor_network) if entropy == "reference" else actor_network
        head = actor_modules(actor_network)[-1]
        if target_entropy == "auto" and isinstance(head, ConstrainedFlowModule):
            target_entropy = usual_target_entropy(head.bounds)
        super().__init__(
            scored, qvalue_network, max_alpha=max_alpha, target_entropy=target_entropy, **kwargs
        )
        self.make_value_estimator(ValueEstimators.TD0, gamma=gamma)


def usual_target_entropy(bounds: Box) -> float:
    r"""Return the target entropy of SAC for actions within bounds.

    It is :math:`-d + \sum_i \log((b_i - a_i) / 2)`: the usual -d for bounds of -1 and 1, and for
    others as much below the entropy of the uniform distribution, whatever units the actions have.

    Args:
        bounds: The action bounds :math:`a, b`, ``(d,)``.
    """
    half_widths = (bounds.high.double() - bounds.low.double()) / 2
    return float(half_widths.log().sum()) - bounds.dim
