"""Soft actor-critic with a Lagrangian for constraints in expectation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import SafeProbabilisticTensorDictSequential
from torchrl.objectives import SACLoss

from cnfp_torchrl.keys import COST_KEY
from cnfp_torchrl.objectives.sac import ConstrainedSACLoss

_REFUSED = ("value_network", "skip_done_states")
"""Options of SACLoss that the cost critic does not follow."""


class SACLagrangianLoss(ConstrainedSACLoss):
    r"""SAC whose actor pays for expected costs, with one learned price for each constraint.

    A cost critic :math:`Q_c(s, a) \in \mathbb{R}^K` estimates the discounted sum of each
    constraint's costs under the policy, and multipliers :math:`\lambda_k = \exp(l_k)` weigh them:

    .. math::
        L_\pi &= E[\alpha \log\pi(a|s) - \min_i Q_i(s, a) + \sum_k \lambda_k Q_{c,k}(s, a)] \\
        L_{Q_c} &= E[\textstyle\sum_k (Q_{c,k}(s, a) - c_k
            - \gamma_c (1 - \text{terminated}) \bar Q_{c,k}(s', a'))^2], \quad a' \sim \pi(s') \\
        L_\lambda &= -\sum_k \lambda_k (E[Q_{c,k}(s, a)] - \epsilon_k), \quad
            0 < \lambda_k \le \lambda_{max}

    with :math:`a \sim \pi(s)` in :math:`L_\pi` and :math:`L_\lambda`: a descent on
    :math:`L_\lambda` is the dual ascent on :math:`\lambda_k (E[Q_{c,k}] - \epsilon_k)`. Costs are
    not negative, so with :math:`\epsilon_k = 0` a multiplier can only rise, up to its bound; with a
    small :math:`\epsilon_k > 0` it can fall again. With several cost networks the largest cost
    counts. Nothing here is guaranteed: constraints hold in expectation, once the critic is right.

    Sources: Ha et al. 2020, "Learning to Walk in the Real World with Minimal Human Effort"
    (arXiv 2002.08550); Yang et al. 2021, "WCSAC: Worst-Case Soft Actor Critic for
    Safety-Constrained Reinforcement Learning".

    Reads ``cost`` under ``next``, float32 ``(*batch, K)``, besides what SAC reads. Writes
    ``loss_cost`` and ``loss_lagrange`` besides SAC's losses, and for the log ``lambda_NAME`` and
    ``cost_value_NAME``, the multiplier and :math:`E[Q_{c,k}]` of each constraint.

    Args:
        actor_network: The actor, see `ConstrainedSACLoss`.
        qvalue_network: The critic, see `ConstrainedSACLoss`.
        cost_network: A critic that reads observation and action and writes ``state_action_cost``
            ``(*batch, K)``; best one that cannot be negative, as costs cannot.
        thresholds: The bounds :math:`\epsilon_k \ge 0`, one for each constraint or a number for
            all, in discounted costs: a violation in every step is worth 1 / (1 - gamma_cost).
        constraint_names: The names of the columns of ``cost``, for the log; None numbers them.
        gamma_cost: The discount of costs, in [0, 1).
        lambda_init: The multipliers' first value, in (0, lambda_max].
        lambda_max: The multipliers' upper bound, > 0.
        num_cost_nets: The number of cost networks, alike but for their weights.
        kwargs: Further options of `ConstrainedSACLoss`.

    Raises:
        ValueError: for a bad argument, naming it, and in ``forward`` for costs of another shape
            than the thresholds'.
    """

    @dataclass
    class _AcceptedKeys(SACLoss._AcceptedKeys):
        cost: NestedKey = COST_KEY
        state_action_cost: NestedKey = "state_action_cost"

    default_keys = _AcceptedKeys
    _value_keys = ConstrainedSACLoss._value_keys | {"cost_network": "state_action_cost"}

    cost_network: TensorDictModule
    cost_network_params: TensorDictParams
    target_cost_network_params: TensorDictParams
    _in_keys: list[NestedKey]
    thresholds: Tensor

    def __init__(
        self,
        actor_network: SafeProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule,
        cost_network: TensorDictModule,
        *,
        thresholds: float | Sequence[float],
        constraint_names: Sequence[str] | None = None,
        gamma_cost: float = 0.99,
        lambda_init: float = 1.0,
        lambda_max: float = 100.0,
        num_cost_nets: int = 1,
        **kwargs: Any,
    ) -> None:
        if isinstance(thresholds, int | float):
            thresholds = [thresholds] * len(
                [None] if constraint_names is None else constraint_names
            )
        limits = list(map(float, thresholds))
        names = list(map(str, range(len(limits))) if constraint_names is None else constraint_names)
        _require(
            len(limits) == len(names) > 0,
            "thresholds",
            f"one number for each of the constraints {names}",
            limits,
        )
        _require(all(0 <= x < math.inf for x in limits), "thresholds", "numbers >= 0", limits)
        _require(0 <= gamma_cost < 1, "gamma_cost", "a discount in [0, 1)", gamma_cost)
        _require(0 < lambda_max < math.inf, "lambda_max", "a number > 0", lambda_max)
        _require(
            0 < lambda_init <= lambda_max,
            "lambda_init",
            f"a number in (0, lambda_max = {lambda_max}]",
            lambda_init,
        )
        _require(num_cost_nets >= 1, "num_cost_nets", "a number >= 1", num_cost_nets)
        for name in _REFUSED:
            _require(
                not kwargs.get(name), name, "it left out, it is not supported", kwargs.get(name)
            )
        reduction = kwargs.get("reduction")
        _require(reduction in (None, "mean", "sum"), "reduction", "'mean' or 'sum'", reduction)

        super().__init__(actor_network, qvalue_network, **kwargs)
        self.convert_to_functional(
            cost_network, "cost_network", num_cost_nets, create_target_params=True
        )
        device = next(self.parameters()).device
        self.register_buffer("thresholds", torch.tensor(limits, device=device))
        start = torch.full((len(limits),), math.log(lambda_init), device=device)
        self.log_lagrange = nn.Parameter(start)
        self.gamma_cost = gamma_cost
        self.lambda_max = lambda_max
        self.constraint_names = tuple(names)
        self._set_in_keys()
        logged = [f"{kind}_{name}" for kind in ("lambda", "cost_value") for name in names]
        self._out_keys = [*self.out_keys, "loss_cost", "loss_lagrange", *logged]

    @property
    def multipliers(self) -> Tensor:
        """The multipliers ``(K,)``, detached and at most ``lambda_max``."""
        self._bound()
        return self.log_lagrange.detach().exp().clamp(max=self.lambda_max)

    def _bound(self) -> None:
        # In place, as SACLoss bounds its temperature. With the output clamped instead, the
        # parameter would run on beyond the bound, and take long to come back.
        self.log_lagrange.data.clamp_(max=math.log(self.lambda_max))

    def _set_in_keys(self) -> None:
        super()._set_in_keys()
        if "cost_network" not in self.__dict__:  # SACLoss calls this before the network is here
            return
        cost = ("next", self.tensor_keys.cost)
        self._in_keys = list({*self._in_keys, cost, *self.cost_network.in_keys})

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return SAC's losses and the two of the Lagrangian, as scalars."""
        loss_qvalue, qvalue_metadata = self.qvalue_v2_loss(tensordict)
        loss_cost = self.cost_loss(tensordict)
        loss_actor, metadata = self.actor_loss(tensordict)
        loss_alpha = self._reduced(self._alpha_loss(metadata["log_prob"]), tensordict)
        tensordict.set(self.tensor_keys.priority, qvalue_metadata["td_error"])
        expected_cost = metadata["cost_value"].flatten(0, -2).mean(0)
        losses = {
            "loss_actor": loss_actor,
            "loss_qvalue": loss_qvalue,
            "loss_alpha": loss_alpha,
            "loss_cost": loss_cost,
            "loss_lagrange": self.lagrange_loss(expected_cost),
            "alpha": self._alpha,
            "entropy": -metadata["log_prob"].mean(),
        }
        multipliers = self.multipliers
        for k, name in enumerate(self.constraint_names):
            losses[f"lambda_{name}"] = multipliers[k]
            losses[f"cost_value_{name}"] = expected_cost[k]
        return TensorDict(losses, batch_size=[])

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the actor's loss, and ``log_prob`` and ``cost_value`` of the drawn actions."""
        action, log_prob = self._draw(tensordict)
        value = self._values("qvalue_network", tensordict, action, detached=True)
        cost = self._costs("cost_network", tensordict, action, detached=True).amax(0)
        price = (self.multipliers * cost).sum(-1)
        loss = self._reduced(self._alpha * log_prob - value.amin(0).squeeze(-1) + price, tensordict)
        return loss, {"log_prob": log_prob.detach(), "cost_value": cost.detach()}

    def cost_loss(self, tensordict: TensorDictBase) -> Tensor:
        """Return the cost critic's loss, summed over constraints and networks."""
        action = tensordict.get(self.tensor_keys.action)
        predicted = self._costs("cost_network", tensordict, action)
        target = self._cost_target(tensordict).expand_as(predicted)
        # Not the robust loss of the value critic, which estimates something like a median: that of
        # a rare event, such as a violation that is mostly avoided, is 0.
        loss = (predicted - target).square()
        return self._reduced(loss.sum(-1).sum(0), tensordict)

    def lagrange_loss(self, expected_cost: Tensor) -> Tensor:
        """Return the multipliers' loss.

        Args:
            expected_cost: The expected cost of each constraint under the policy, ``(K,)``.
        """
        self._bound()
        return -(self.log_lagrange.exp() * (expected_cost.detach() - self.thresholds)).sum()

    @torch.no_grad()
    def _cost_target(self, tensordict: TensorDictBase) -> Tensor:
        outcome = tensordict.get("next")
        cost = outcome.get(self.tensor_keys.cost)
        expected = (*tensordict.shape, len(self.constraint_names))
        if cost.shape != expected:
            raise ValueError(
                f"key ('next', {self.tensor_keys.cost!r}): expected a cost for each of the "
                f"constraints {list(self.constraint_names)}, shape {tuple(expected)}, given "
                f"{tuple(cost.shape)}"
            )
        action, _ = self._draw(outcome)
        next_cost = self._costs("target_cost_network", outcome, action).amax(0)
        continues = ~outcome.get(self.tensor_keys.terminated)
        return cost + self.gamma_cost * continues * next_cost

    def _costs(
        self, name: str, tensordict: TensorDictBase, action: Tensor, *, detached: bool = False
    ) -> Tensor:
        """Return the cost values of actions, ``(num_cost_nets, *batch, K)``; see `_values`."""
        cost = self._values(name, tensordict, action, detached=detached)
        if cost.shape[-1] != len(self.constraint_names):
            raise ValueError(
                f"cost_network: expected an output for each of the constraints "
                f"{list(self.constraint_names)}, given {cost.shape[-1]}"
            )
        return cost


def _require(good: bool, name: str, expected: str, given: object) -> None:
    if not good:
        raise ValueError(f"{name}: expected {expected}, given {given!r}")
