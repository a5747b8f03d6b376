"""A last check of executed actions, for evaluation and deployment."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.geometry import Region
from cnfp_torchrl.modules.action_bounds import action_bounds, refuse_other_bounds
from cnfp_torchrl.modules.actors import flow_head
from cnfp_torchrl.modules.exploration import refuse_exploration
from cnfp_torchrl.modules.flow_module import refuse_other_batch


class ConstraintViolationError(RuntimeError):
    """An action about to be executed lies outside a set that it must lie in."""


def refuse_violations(names: Sequence[str], region: Region, action: Tensor) -> None:
    """Raise if an action lies outside the action bounds or an active constraint's set.

    The check has zero tolerance and is done in float64. Reads the action on the host.

    Args:
        names: The constraints' names, in the order of the region's sets behind the bounds.
        region: The region of allowed actions.
        action: The action as it will be executed, ``(*batch, d)``.

    Raises:
        ConstraintViolationError: naming constraint, batch index, action and slack.
    """
    refuse_other_batch("action", action, region.anchor.shape[:-1])
    if bool(region.contains(action).all()):
        return
    for stage, (name, each) in enumerate(zip(["bounds", *names], region.widened(), strict=True)):
        bad = ~each.contains(action)
        counts = region.counts(stage)
        if counts is not None:
            bad = bad & counts
        if bool(bad.any()):
            index = tuple(int(i) for i in bad.nonzero()[0])
            # In float64, as `contains`: in float32 the slack may round to 0.
            exact = each.to(torch.float64)
            slack = exact.slack(action.double())[index].item()
            relaxed = _relaxed(region, stage, index)
            raise ConstraintViolationError(
                f"constraint '{name}': expected an action inside its set{relaxed}, given "
                f"{action[index].tolist()} with slack {slack:.3g} at batch index {list(index)}"
            )
    raise AssertionError("an action is outside the region but inside all of its sets")


def _relaxed(region: Region, stage: int, index: tuple[int, ...]) -> str:
    """Say by how much a set is relaxed in a state, if it is."""
    if region.relaxation is None or stage == 0:
        return ""
    amount = region.relaxation[stage].amax(-1)
    amount = amount.expand(torch.broadcast_shapes(amount.shape, (1,) * len(index)))
    largest = amount[tuple(i if n > 1 else 0 for i, n in zip(index, amount.shape, strict=True))]
    return f" widened by {largest.item():.3g}" if bool(largest > 0) else ""


class ExecutedActionGuard(TensorDictModuleBase):
    """Raise if an action lies outside the action bounds or an active constraint's set.

    It never repairs: a repaired action would hide the fault and falsify its log-density. Chain it
    after a policy; `cnfp_torchrl.envs.ActionGuard` guards an environment against all policies.

    Args:
        actor: The constrained actor whose constraints are checked.

    Raises:
        TypeError: when the actor is not a constrained one.
        ConstraintViolationError: when called, naming constraint, batch index, action and slack.
    """

    def __init__(self, actor: SafeProbabilisticTensorDictSequential) -> None:
        super().__init__()
        self.head = head = flow_head(actor)
        self.in_keys = [head.action_key, *head.geometry_keys()]
        self.out_keys = [head.action_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the tensordict unchanged, or raise."""
        action = tensordict.get(self.head.action_key).detach()
        refuse_violations(self.head.order, self.head.get_region(tensordict), action)
        return tensordict


def guarded(
    actor: SafeProbabilisticTensorDictSequential, env: EnvBase | None = None
) -> TensorDictModuleBase:
    """Return the actor with a guard behind it, or as it is if its flow guarantees nothing.

    Args:
        actor: A constrained actor.
        env: The environment in which it is to act; None leaves its action bounds unchecked.

    Raises:
        TypeError: when the actor is not a constrained one, or explores behind its flow.
        ValueError: when its action bounds are not the environment's.
    """
    refuse_exploration(actor)
    if env is not None:
        bounds = action_bounds(env.full_action_spec, env.action_key)
        refuse_other_bounds("actor", flow_head(actor).bounds, bounds)
    if not flow_head(actor).flow.is_safe:
        return actor
    return TensorDictSequential(actor, ExecutedActionGuard(actor))
