"""A last check of executed actions, for evaluation and deployment."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.geometry import Box, Region
from cnfp_torchrl.modules.action_bounds import action_bounds, refuse_other_bounds
from cnfp_torchrl.modules.actors import flow_head
from cnfp_torchrl.modules.exploration import refuse_exploration
from cnfp_torchrl.modules.flow_module import ConstrainedFlowModule, refuse_other_batch


class ConstraintViolationError(RuntimeError):
    """An action about to be executed lies outside a set that it must lie in."""


class RelaxedConstraintError(ConstraintViolationError):
    """A constraint gave way in a state in which an action is about to be executed."""


def refuse_violations(names: Sequence[str], region: Region, action: Tensor) -> None:
    """Raise if an action lies outside the action bounds or a constraint's set, relaxed or not.

    The check has zero tolerance and is done in float64. Reads the action on the host.

    Args:
        names: The constraints' names, in the order of the region's sets behind the bounds.
        region: The region of allowed actions.
        action: The action as it will be executed, ``(*batch, d)``.

    Raises:
        ConstraintViolationError: naming constraint, batch index, action and slack, and whether the
            set is the constraint's own or had been widened.
    """
    refuse_other_batch("action", action, region.anchor.shape[:-1])
    if bool(region.contains(action).all()):
        return
    for stage, (name, constraint_set) in enumerate(
        zip(["bounds", *names], region.widened(), strict=True)
    ):
        bad = ~constraint_set.contains(action)
        counts = region.counts(stage)
        if counts is not None:
            bad = bad & counts
        if bool(bad.any()):
            index = tuple(int(i) for i in bad.nonzero()[0])
            # In float64, as `contains`: in float32 the slack may round to 0.
            exact = constraint_set.to(torch.float64)
            slack = exact.slack(action.double())[index].item()
            amount = _relaxation(region, stage, index)
            relaxed = f" widened by {amount:.3g}, as it is relaxed there" if amount else ""
            raise ConstraintViolationError(
                f"constraint '{name}': expected an action inside its set{relaxed}, given "
                f"{action[index].tolist()} with slack {slack:.3g} at batch index {list(index)}"
            )
    raise AssertionError("an action is outside the region but inside all of its sets")


def refuse_relaxed(names: Sequence[str], region: Region, executed: Tensor | None = None) -> None:
    """Raise if a constraint is relaxed or dropped in a state. Reads the flags on the host.

    Args:
        names: The constraints' names, in the order of the region's sets behind the bounds.
        region: The region of allowed actions.
        executed: The mask of the states that count, boolean ``(*batch,)``; None means all.

    Raises:
        RelaxedConstraintError: naming constraint, batch index and amount.
    """
    if region.active is None:
        return
    gave_way = ~region.active
    if executed is not None:
        gave_way = gave_way & executed.unsqueeze(-1)
    if not bool(gave_way.any()):
        return
    *index, stage = (int(i) for i in gave_way.nonzero()[0])
    amount = _relaxation(region, stage, tuple(index))
    how = f"relaxed by {amount:.3g}" if 0 < amount < math.inf else "dropped"
    raise RelaxedConstraintError(
        f"constraint '{names[stage - 1]}': expected to hold in each state, as refuse_relaxation "
        f"asks, but it is {how} at batch index {index}: no action keeps it together with the "
        "bounds and the constraints of higher priority"
    )


def _relaxation(region: Region, stage: int, index: tuple[int, ...]) -> float:
    """Return by how much a set is relaxed in a state; 0 also where that is unknown."""
    if region.relaxation is None or stage == 0:
        return 0.0
    amount = region.relaxation[stage].amax(-1)
    return float(amount.expand(region.anchor.shape[:-1])[index])


class ExecutedActionGuard(TensorDictModuleBase):
    """Raise if an action lies outside the action bounds or a constraint's set.

    Where a constraint is relaxed its set is the widened one, and where it is dropped nothing is
    asked; `refuse_relaxation` refuses such states altogether.

    It never repairs: a repaired action would hide the fault and falsify its log-density. Chain it
    after a policy; `cnfp_torchrl.envs.ActionGuard` guards an environment against all policies.

    Args:
        actor: The constrained actor whose constraints are checked.
        refuse_relaxation: Whether to raise, too, in states in which a constraint is not active,
            whatever the action. A set without interior, such as an equality, is never active.

    Raises:
        TypeError: when the actor is not a constrained one.
        ConstraintViolationError: when called, naming constraint, batch index, action and slack.
        RelaxedConstraintError: when called, with `refuse_relaxation`.
    """

    def __init__(
        self, actor: SafeProbabilisticTensorDictSequential, *, refuse_relaxation: bool = False
    ) -> None:
        super().__init__()
        self.refuse_relaxation = refuse_relaxation
        self.head = head = flow_head(actor)
        self.in_keys = [head.action_key, *head.geometry_keys()]
        self.out_keys = [head.action_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the tensordict unchanged, or raise."""
        action = tensordict.get(self.head.action_key).detach()
        region = self.head.get_region(tensordict)
        if self.refuse_relaxation:
            refuse_relaxed(self.head.order, region)
        refuse_violations(self.head.order, region, action)
        return tensordict


def refuse_misfit(policy: nn.Module, bounds: Box, action_key: NestedKey) -> None:
    """Refuse a policy that cannot act in an environment within its constraints.

    Args:
        policy: A policy, such as a constrained actor alone or in a sequence; others are not judged.
        bounds: The environment's action bounds, ``(d,)``.
        action_key: The environment's key of the action.

    Raises:
        TypeError: when it explores behind its flow.
        ValueError: when the action bounds of its flow are not the environment's.
    """
    refuse_exploration(policy)
    for module in policy.modules():
        if isinstance(module, ConstrainedFlowModule) and module.action_key == action_key:
            refuse_other_bounds("actor", module.bounds, bounds)


def guarded(
    actor: SafeProbabilisticTensorDictSequential,
    env: EnvBase | None = None,
    *,
    refuse_relaxation: bool = False,
) -> TensorDictModuleBase:
    """Return the actor with a guard behind it, or as it is if its flow guarantees nothing.

    Args:
        actor: A constrained actor.
        env: The environment in which it is to act; None leaves its action bounds unchecked.
        refuse_relaxation: Whether the guard raises, too, in states in which a constraint is not
            active; see `ExecutedActionGuard`.

    Raises:
        TypeError: when the actor is not a constrained one, or explores behind its flow.
        ValueError: when its action bounds are not the environment's, and for `refuse_relaxation`
            with a flow that guarantees nothing.
    """
    refuse_exploration(actor)
    flow = flow_head(actor).flow
    if env is not None:
        refuse_misfit(actor, action_bounds(env.full_action_spec, env.action_key), env.action_key)
    if not flow.is_safe:
        if refuse_relaxation:
            raise ValueError(
                f"refuse_relaxation: expected False for {type(flow).__name__}, which guarantees "
                "nothing and is not guarded, given True; take flow='exact'"
            )
        return actor
    return TensorDictSequential(
        actor, ExecutedActionGuard(actor, refuse_relaxation=refuse_relaxation)
    )
