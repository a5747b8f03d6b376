"""Actors with hard action constraints: from a network, or from an actor that exists."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from tensordict.utils import NestedKey
from torch import nn
from torchrl.data import Composite, TensorSpec
from torchrl.modules import (
    IndependentNormal,
    SafeProbabilisticTensorDictSequential,
    TanhNormal,
)

from cnfp_torchrl.geometry import Box
from cnfp_torchrl.modules.constraint_bijector import ConstraintBijector, refuse_string
from cnfp_torchrl.modules.flow_module import (
    ConstrainedFlowModule,
    ReferenceEntropyFlowModule,
    action_bounds,
)
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

    Raises:
        TypeError: when `in_keys` or `order` is a string, or a bijector is none.
        ValueError: see `ConstrainedFlowModule`.
    """
    refuse_string("in_keys", in_keys)
    parameters = TensorDictModule(network, in_keys=list(in_keys), out_keys=["loc", "scale"])
    head = ConstrainedFlowModule(
        spec, bijectors, order=order, flow=flow, return_log_prob=return_log_prob
    )
    return SafeProbabilisticTensorDictSequential(parameters, head)


def constrain(
    actor: ProbabilisticTensorDictSequential,
    *bijectors: ConstraintBijector,
    flow: Flow | str = "exact",
    order: Sequence[str] | None = None,
    spec: TensorSpec | None = None,
) -> SafeProbabilisticTensorDictSequential:
    """Return the actor with constraints appended; its networks are shared, not copied.

    The actor's last module must draw from a `TanhNormal` or an `IndependentNormal`: its Gaussian
    parameters become the base of the flow, so that a tanh is not applied twice. Keys, log-prob and
    default interaction type stay as they are. An actor that is constrained already keeps its
    constraints: the new ones are applied after them, with higher priority, unless `order` says
    otherwise, and `flow` takes the place of its flow.

    Args:
        actor: a `torchrl.modules.ProbabilisticActor` or another sequence that ends in a
            probabilistic module.
        bijectors: one for each constraint, in order of application unless `order` is given; none
            only where the actor is constrained already, to change its flow or order.
        flow: see `ConstrainedFlowModule`.
        order: see `ConstrainedFlowModule`.
        spec: the bounded action spec; None takes the actor's own.

    Raises:
        TypeError: when the actor does not end in a distribution that can be a base, when a bijector
            is none, or when the order is a string.
        ValueError: when bounds are missing or are not those of the TanhNormal, when the
            distribution is more than a Gaussian of location and scale, when an order does not
            name each constraint once, or when there would be no constraint.
    """
    *body, head = actor_modules(actor)
    parameter_keys = _parameter_keys(head)
    action_key = head.dist_sample_keys[0]
    spec = getattr(head, "spec", None) if spec is None else spec
    if spec is None or (isinstance(spec, Composite) and spec[action_key] is None):
        raise ValueError(
            "spec: expected the bounded action spec, but the actor has none; pass "
            "constrain(..., spec=env.action_spec_unbatched)"
        )
    _refuse_other_bounds(head, action_bounds(spec, action_key))
    is_constrained = isinstance(head, ConstrainedFlowModule)
    if not bijectors and not is_constrained:
        raise ValueError(
            "bijectors: expected at least one for an actor that is not constrained yet, given "
            "none; pass constrain(actor, *constraint_bijectors(env))"
        )
    before = head.bijectors if is_constrained else []
    constrained = ConstrainedFlowModule(
        spec,
        [*before, *bijectors],
        order=order,
        flow=flow,
        in_keys=parameter_keys,
        out_key=action_key,
        **_other_options(head),
    )
    return SafeProbabilisticTensorDictSequential(*body, constrained)


def with_reference_entropy(
    actor: ProbabilisticTensorDictSequential,
) -> SafeProbabilisticTensorDictSequential:
    """Return a view of a constrained actor, for a loss, whose samples carry the reference entropy.

    Parameters are shared. See `cnfp_torchrl.distributions.ReferenceEntropyFlow`.

    Raises:
        TypeError: when the actor does not end in a `ConstrainedFlowModule`.
    """
    head = flow_head(actor)
    view = ReferenceEntropyFlowModule(
        head.spec,
        head.bijectors,
        flow=head.flow,
        in_keys=head.parameter_keys,
        out_key=head.action_key,
        **_other_options(head),
    )
    return SafeProbabilisticTensorDictSequential(*actor_modules(actor)[:-1], view)


def flow_head(actor: ProbabilisticTensorDictSequential) -> ConstrainedFlowModule:
    """Return the flow module that ends a constrained actor.

    Raises:
        TypeError: when the actor is not a constrained one.
    """
    head = actor_modules(actor)[-1]
    if not isinstance(head, ConstrainedFlowModule):
        raise TypeError(
            f"actor: expected one that ends in a ConstrainedFlowModule, given {type(head).__name__}"
            "; build it with make_constrained_actor or constrain"
        )
    return head


def has_density(actor: ProbabilisticTensorDictSequential) -> bool:
    """Tell whether an actor's actions have a log-density, which projected ones have not."""
    head = actor_modules(actor)[-1]
    return head.flow.has_density if isinstance(head, ConstrainedFlowModule) else True


def actor_modules(actor: ProbabilisticTensorDictSequential) -> list[Any]:
    """Return the modules of an actor in order; the last one draws the action.

    Raises:
        TypeError: when the actor is no sequence that ends in a probabilistic module.
    """
    if not isinstance(actor, ProbabilisticTensorDictSequential):
        raise TypeError(
            "actor: expected a sequence that ends in a probabilistic module, such as a "
            f"ProbabilisticActor, given {type(actor).__name__}"
        )
    modules = actor.module
    return list(modules.values() if isinstance(modules, nn.ModuleDict) else modules)


def _parameter_keys(head: Any) -> list[NestedKey]:
    """Return the keys of location and scale, or refuse a head that is no base of a flow."""
    if isinstance(head, ConstrainedFlowModule):
        return head.parameter_keys
    kind = getattr(head, "distribution_class", type(head))
    if kind not in (TanhNormal, IndependentNormal):
        raise TypeError(
            "actor: expected TanhNormal or IndependentNormal as the distribution to constrain, "
            f"given {getattr(kind, '__name__', kind)}; end the actor with one of these"
        )
    options = dict(head.distribution_kwargs)
    if options.get("tanh_loc", False):
        raise ValueError(
            "actor: expected distribution_kwargs without tanh_loc=True, which moves the Gaussian's "
            "location outside the network; switch it off"
        )
    event_dims = options.get("event_dims", options.get("event_dim"))
    if event_dims not in (None, 1):
        raise ValueError(
            f"actor: expected a distribution over vectors, event_dims = 1, given {event_dims}"
        )
    names = [key if isinstance(key, str) else key[-1] for key in head.dist_keys]
    if sorted(names) != ["loc", "scale"]:
        raise ValueError(
            "actor: expected a distribution that reads location and scale from the tensordict, "
            f"in_keys for 'loc' and 'scale', given {names}"
        )
    keys = dict(zip(names, head.in_keys, strict=True))
    return [keys["loc"], keys["scale"]]


def _refuse_other_bounds(head: Any, bounds: Box) -> None:
    if head.distribution_class is not TanhNormal:
        return
    for name, usual, expected in (("low", -1.0, bounds.low), ("high", 1.0, bounds.high)):
        given = torch.as_tensor(head.distribution_kwargs.get(name, usual)).to(expected)
        if not bool((given == expected).all()):
            raise ValueError(
                f"actor: expected a TanhNormal with the action spec's {name} {expected.tolist()}, "
                f"given {given.tolist()}; build it with distribution_kwargs={{'low': "
                "spec.space.low, 'high': spec.space.high}"
            )


def _other_options(head: Any) -> dict[str, Any]:
    """Return what a head does besides its distribution, which another one is to do likewise."""
    return {
        "return_log_prob": head.return_log_prob,
        "log_prob_key": head.log_prob_key,
        "default_interaction_type": head.default_interaction_type,
        "num_samples": head.num_samples,
    }
