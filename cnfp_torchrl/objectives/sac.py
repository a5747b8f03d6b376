"""Soft actor-critic for constrained actors."""

from __future__ import annotations

from typing import Any, Literal

from tensordict.nn import TensorDictModule
from torchrl.modules import SafeProbabilisticTensorDictSequential
from torchrl.objectives import ValueEstimators

from cnfp_torchrl.modules import (
    ConstrainedFlowModule,
    actor_modules,
    has_density,
    with_reference_entropy,
)
from cnfp_torchrl.objectives.batched_sac import BatchedSACLoss

Entropy = Literal["reference", "action"]


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
        kwargs: Further options of `torchrl.objectives.SACLoss`.

    Raises:
        ValueError: for an unknown entropy, for ``action`` where actions have no density, for a
            discount outside [0, 1), and for a batched spec where the target entropy -d is to be
            read from it.
    """

    def __init__(
        self,
        actor_network: SafeProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule,
        *,
        entropy: Entropy = "reference",
        gamma: float = 0.99,
        max_alpha: float = 10.0,
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
        super().__init__(scored, qvalue_network, max_alpha=max_alpha, **kwargs)
        head = actor_modules(actor_network)[-1]
        if kwargs.get("target_entropy", "auto") == "auto" and isinstance(
            head, ConstrainedFlowModule
        ):
            self._require_target_entropy(head.action_dim)
        self.make_value_estimator(ValueEstimators.TD0, gamma=gamma)

    def _require_target_entropy(self, action_dim: int) -> None:
        # SACLoss counts the numbers of the spec, those of all batch elements of a batched one.
        counted = -round(float(self.target_entropy))
        if counted != action_dim:
            raise ValueError(
                f"action_spec: expected that of one action, with {action_dim} components, given "
                f"one with {counted}, which would make the target entropy {-counted} in place of "
                f"{-action_dim}; pass action_spec=env.action_spec_unbatched"
            )
