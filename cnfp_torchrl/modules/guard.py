"""A last check of executed actions, for evaluation and deployment."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.modules.actors import flow_head
from cnfp_torchrl.modules.flow_module import ConstrainedFlowModule


class ConstraintViolationError(RuntimeError):
    """An action about to be executed lies outside a set that it must lie in."""


class ExecutedActionGuard(TensorDictModuleBase):
    """Raise if an action lies outside the action bounds or an active constraint's set.

    The check has zero tolerance and is done in float64 on the action as it will be executed. It
    never repairs: a repaired action would hide the fault and falsify its log-density. Chain it
    after a policy. Reads the action on the host.

    Args:
        head: the flow module of the constrained actor.

    Raises:
        ConstraintViolationError: naming constraint, batch index, action and slack.
    """

    def __init__(self, head: ConstrainedFlowModule) -> None:
        super().__init__()
        self._names = ["bounds", *head.order]
        self.head = head
        self.in_keys = [head.action_key, *head.geometry_keys()]
        self.out_keys = [head.action_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the tensordict unchanged, or raise."""
        action = tensordict.get(self.head.action_key).detach()
        region = self.head.get_region(tensordict)
        if bool(region.contains(action).all()):
            return tensordict
        for stage, (name, each) in enumerate(zip(self._names, region.sets, strict=True)):
            bad = ~each.contains(action)
            if region.active is not None:
                bad = bad & region.active[..., stage]
            if bool(bad.any()):
                index = tuple(int(i) for i in bad.nonzero()[0])
                # In float64, as `contains`: in float32 the slack may round to 0.
                exact = each.with_fields(lambda field, _: field.double())
                slack = float(exact.slack(action.double())[index])
                raise ConstraintViolationError(
                    f"constraint '{name}': expected an action inside its set, given "
                    f"{action[index].tolist()} with slack {slack:.3g} at batch index {list(index)}"
                )
        raise AssertionError("an action is outside the region but inside all of its sets")


def guarded(actor: SafeProbabilisticTensorDictSequential) -> TensorDictModuleBase:
    """Return the actor with a guard behind it, or as it is if its flow guarantees nothing."""
    head = flow_head(actor)
    if not head.flow.is_exact:
        return actor
    return TensorDictSequential(actor, ExecutedActionGuard(head))
