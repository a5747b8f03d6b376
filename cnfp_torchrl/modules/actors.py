"""Actors with hard action constraints: from a network, or from an actor that exists."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict.nn import ProbabilisticTensorDictModule, TensorDictModule
from tensordict.utils import NestedKey
from torch import nn
from torchrl.data import TensorSpec
from torchrl.modules import (
    IndependentNormal,
    SafeProbabilisticTensorDictSequential,
    TanhNormal,
)

from cnfp_torchrl.modules.constraint_bijector import ConstraintBijector
from cnfp_torchrl.modules.flow_module import ConstrainedFlowModule, ReferenceEntropyFlowModule
from cnfp_torchrl.modules.flows import Flow


def make_constrained_actor(
    network: nn.Module,
    spec: TensorSpec,
    bijectors: Sequence[ConstraintBijector],
    *,
    in_keys: Sequence[NestedKey] = ("observation",),
    order: Sequence[str] | None = None,
    flow: Flow | str = "exact",
    return_log_prob: bool = False,
) -> SafeProbabilisticTensorDictSequential:
    """Return an actor whose every action satisfies the constraints.

    Args:
        network: maps the observations to location and scale of a Gaussian, two tensors
            ``(*batch, d)``; `torchrl.modules.NormalParamExtractor` ends such a network.
        spec: the bounded action spec, such as ``env.action_spec_unbatched``.
        bijectors: one for each constraint.
        in_keys: what the network reads.
        order: see `ConstrainedFlowModule`.
        flow: see `ConstrainedFlowModule`.
        return_log_prob: also write ``action_log_prob``.
    """
    parameters = TensorDictModule(network, in_keys=list(in_keys), out_keys=["loc", "scale"])
    head = ConstrainedFlowModule(
        spec, bijectors, order=order, flow=flow, return_log_prob=return_log_prob
    )
    return SafeProbabilisticTensorDictSequential(parameters, head)


def constrain(
    actor: SafeProbabilisticTensorDictSequential,
    *bijectors: ConstraintBijector,
    flow: Flow | str = "exact",
    order: Sequence[str] | None = None,
    spec: TensorSpec | None = None,
) -> SafeProbabilisticTensorDictSequential:
    """Return the actor with constraints appended; its networks are shared, not copied.

    The actor's last module must draw from a `TanhNormal` or an `IndependentNormal`: its Gaussian
    parameters become the base of the flow, so that a tanh is not applied twice.

    Args:
        actor: a `torchrl.modules.ProbabilisticActor` or another sequence that ends in a
            probabilistic module.
        bijectors: one for each constraint, in order of application unless `order` is given.
        flow: see `ConstrainedFlowModule`.
        order: see `ConstrainedFlowModule`.
        spec: the bounded action spec; None takes the actor's own.

    Raises:
        TypeError: when the actor does not end in a distribution that can be a base.
        ValueError: when bounds are missing or the distribution moves its parameters.
    """
    *body, head = list(actor.module)
    if not isinstance(head, ProbabilisticTensorDictModule):
        raise TypeError(
            "actor: expected a sequence that ends in a probabilistic module (ProbabilisticActor), "
            f"given one that ends in {type(head).__name__}"
        )
    _refuse_unsuitable_base(head)
    spec = head.spec if spec is None else spec
    if spec is None or (hasattr(spec, "keys") and spec[head.out_keys[0]] is None):
        raise ValueError(
            "spec: expected the bounded action spec, but the actor has none; pass "
            "constrain(..., spec=env.action_spec_unbatched)"
        )
    constrained = ConstrainedFlowModule(
        spec,
        bijectors,
        order=order,
        flow=flow,
        in_keys=head.in_keys,
        out_key=head.out_keys[0],
        return_log_prob=head.return_log_prob,
    )
    return SafeProbabilisticTensorDictSequential(*body, constrained)


def with_reference_entropy(
    actor: SafeProbabilisticTensorDictSequential,
) -> SafeProbabilisticTensorDictSequential:
    """Return a view of a constrained actor, for a loss, whose samples carry the reference entropy.

    Parameters are shared. See `cnfp_torchrl.distributions.ReferenceEntropyFlow`.

    Raises:
        TypeError: when the actor does not end in a `ConstrainedFlowModule`.
    """
    body, head = list(actor.module)[:-1], flow_head(actor)
    view = ReferenceEntropyFlowModule(
        head.spec,
        head.bijectors,
        flow=head.flow,
        in_keys=head.parameter_keys,
        out_key=head.action_key,
        return_log_prob=head.return_log_prob,
    )
    return SafeProbabilisticTensorDictSequential(*body, view)


def flow_head(actor: SafeProbabilisticTensorDictSequential) -> ConstrainedFlowModule:
    """Return the flow module that ends a constrained actor.

    Raises:
        TypeError: when the actor is not a constrained one.
    """
    head = list(actor.module)[-1]
    if not isinstance(head, ConstrainedFlowModule):
        raise TypeError(
            f"actor: expected one that ends in a ConstrainedFlowModule, given {type(head).__name__}"
            "; build it with make_constrained_actor or constrain"
        )
    return head


def _refuse_unsuitable_base(head: ProbabilisticTensorDictModule) -> None:
    kind: Any = head.distribution_class
    if kind not in (TanhNormal, IndependentNormal) and not isinstance(head, ConstrainedFlowModule):
        raise TypeError(
            "actor: expected TanhNormal or IndependentNormal as the distribution to constrain, "
            f"given {getattr(kind, '__name__', kind)}; end the actor with one of these"
        )
    if dict(head.distribution_kwargs).get("tanh_loc", False):
        raise ValueError(
            "actor: expected distribution_kwargs without tanh_loc=True, which moves the Gaussian's "
            "location outside the network; switch it off"
        )
    if len(head.in_keys) != 2 and not isinstance(head, ConstrainedFlowModule):
        raise ValueError(f"actor: expected two in_keys, location and scale, given {head.in_keys}")
