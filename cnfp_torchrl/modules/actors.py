"""Actors with hard action constraints, made of a network or of another actor."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictSequential,
)
from tensordict.utils import NestedKey
from torch import nn
from torchrl.data import Composite, TensorSpec
from torchrl.envs import EnvBase
from torchrl.modules import (
    IndependentNormal,
    SafeProbabilisticTensorDictSequential,
    TanhNormal,
)

from cnfp_torchrl.geometry import Box
from cnfp_torchrl.keys import ACTION_KEY, LOC_KEY, SCALE_KEY, refuse_string
from cnfp_torchrl.modules.action_bounds import action_bounds, refuse_other_bounds
from cnfp_torchrl.modules.constraint_bijector import ConstraintBijector, in_order
from cnfp_torchrl.modules.exploration import refuse_exploration
from cnfp_torchrl.modules.flow_module import ConstrainedFlowModule, ReferenceEntropyFlowModule
from cnfp_torchrl.modules.flows import Flow
from cnfp_torchrl.modules.network_fit import require_fit
from cnfp_torchrl.modules.parameter_network import ParameterNetwork
from cnfp_torchrl.modules.publisher import constraint_bijectors


def make_constrained_actor(
    network: nn.Module,
    env: EnvBase | None = None,
    *,
    bijectors: Sequence[ConstraintBijector] | None = None,
    spec: TensorSpec | None = None,
    order: Sequence[str] | None = None,
    flow: Flow | str = "exact",
    in_keys: Sequence[NestedKey] = ("observation",),
    return_log_prob: bool = False,
) -> SafeProbabilisticTensorDictSequential:
    """Return an actor whose every action satisfies the constraints.

    Constraints, their priority and the action bounds are those of the environment. Where there is
    none, give `bijectors` and `spec` in its place.

    Args:
        network: A map from observations to location and scale of a Gaussian, two tensors
            ``(*batch, d)``; `torchrl.modules.NormalParamExtractor` ends such a network.
        env: An environment of `constrain_env`.
        bijectors: One for each constraint in order of application, the last with the highest
            priority; without `env`.
        spec: The bounded action spec of one state, ``(d,)``; without `env`.
        order: The constraints' names in order of application: another order than that of
            `bijectors`, or a check of the environment's, which is set in `constrain_env`.
        flow: The rule that combines the sets, see `ConstrainedFlowModule`.
        in_keys: The keys of what the network reads.
        return_log_prob: Whether to write the action's log-density, too.

    Raises:
        TypeError: when `env` is no environment, a sequence of names is a string, or a bijector is
            no `ConstraintBijector`.
        ValueError: when both or neither of `env` and `bijectors` with `spec` are given, when two
            statements differ, when the network does not fit the environment, or see
            `ConstrainedFlowModule`.
    """
    refuse_string("in_keys", in_keys)
    statement = _stated(env, bijectors, spec, order)
    if statement.bijectors is None or statement.spec is None:
        missing = "bijectors" if statement.bijectors is None else "spec"
        raise ValueError(
            f"{missing}: expected an environment, or both bijectors and spec, given neither "
            f"environment nor {missing}; write make_constrained_actor(network, env)"
        )
    parameters = ParameterNetwork(network, in_keys=list(in_keys), out_keys=[LOC_KEY, SCALE_KEY])
    head = ConstrainedFlowModule(
        statement.spec,
        statement.bijectors,
        order=order,
        flow=flow,
        out_key=ACTION_KEY if env is None else env.action_key,
        return_log_prob=return_log_prob,
    )
    if env is not None:
        require_fit("network", parameters, env, head.parameter_keys, head.action_dim)
    return SafeProbabilisticTensorDictSequential(parameters, head)


def constrain(
    actor: ProbabilisticTensorDictSequential,
    env: EnvBase | None = None,
    *,
    bijectors: Sequence[ConstraintBijector] | None = None,
    spec: TensorSpec | None = None,
    order: Sequence[str] | None = None,
    flow: Flow | str = "exact",
) -> SafeProbabilisticTensorDictSequential:
    """Return the actor with constraints appended; its networks are shared, not copied.

    Constraints, their priority and the action bounds are those of the environment. Where there is
    none, give `bijectors` in its place, and `spec` unless the actor has one.

    The actor's last module must draw from a `TanhNormal` or an `IndependentNormal`: its Gaussian
    parameters become the base of the flow, so that a tanh is not applied twice. Keys, log-prob and
    default interaction type stay as they are. An actor that is constrained already keeps its
    constraints: further bijectors are applied after them, with higher priority, and `flow` takes
    the place of its flow.

    Args:
        actor: A `torchrl.modules.ProbabilisticActor` or another sequence that ends in a
            probabilistic module.
        env: An environment of `constrain_env`.
        bijectors: One for each constraint in order of application, the last with the highest
            priority; without `env`. None only where the actor is constrained already.
        spec: The bounded action spec of one state, ``(d,)``; without `env`. None takes the actor's
            own.
        order: The constraints' names in order of application: another order than that of
            `bijectors`, or a check of the environment's, which is set in `constrain_env`.
        flow: The rule that combines the sets, see `ConstrainedFlowModule`.

    Raises:
        TypeError: when the actor does not end in a distribution that can be a base, when `env` is
            no environment, a bijector is no `ConstraintBijector`, or the order is a string.
        ValueError: when bounds are missing or are not those of the TanhNormal, when two statements
            differ, when the distribution is more than a Gaussian of location and scale, when an
            order does not name each constraint once, when the actor's networks do not fit the
            environment, or when there would be no constraint.
    """
    *body, head = actor_modules(actor)
    parameter_keys = _parameter_keys(head)
    action_key = head.dist_sample_keys[0]
    own_spec = _own_spec(head, action_key)
    statement = _stated(env, bijectors, spec, order)
    if (spec := own_spec if statement.spec is None else statement.spec) is None:
        raise ValueError(
            "spec: expected the bounded action spec, but the actor has none; pass "
            "constrain(actor, env), or constrain(..., spec=SPEC) without an environment"
        )
    bounds = action_bounds(spec, action_key)
    if own_spec is not None:
        refuse_other_bounds("actor", action_bounds(own_spec, action_key), bounds)
    _refuse_other_tanh_bounds(head, bounds)
    before = head.bijectors if isinstance(head, ConstrainedFlowModule) else []
    after = [] if statement.bijectors is None else statement.bijectors
    if not before and not after:
        raise ValueError(
            "bijectors: expected at least one for an actor that is not constrained yet, given "
            "none; pass constrain(actor, env), or bijectors where there is no environment"
        )
    if env is None:
        after = [*before, *after]
    elif unknown := {b.name for b in before} - {b.name for b in after}:
        raise ValueError(
            f"env: expected one that publishes the constraints that the actor has, given one "
            f"without {sorted(unknown)}; constrain the actor as it was before"
        )
    constrained = ConstrainedFlowModule(
        spec,
        after,
        order=order,
        flow=flow,
        in_keys=parameter_keys,
        out_key=action_key,
        **_other_options(head),
    )
    if env is not None:
        network = TensorDictSequential(*body)
        require_fit("actor", network, env, parameter_keys, constrained.action_dim)
    return SafeProbabilisticTensorDictSequential(*body, constrained)


class _Statement(NamedTuple):
    """The statement of constraints and bounds, by an environment or by the caller."""

    bijectors: list[ConstraintBijector] | None
    spec: TensorSpec | None


def _stated(
    env: EnvBase | None,
    bijectors: Sequence[ConstraintBijector] | None,
    spec: TensorSpec | None,
    order: Sequence[str] | None,
) -> _Statement:
    """Return the one statement of constraints and bounds; refuse two that could differ."""
    refuse_string("order", order)
    if env is None:
        return _Statement(None if bijectors is None else in_order(bijectors, None), spec)
    if not isinstance(env, EnvBase):
        raise TypeError(
            f"env: expected a TorchRL environment, given {type(env).__name__}; where there is "
            "none, write bijectors=[...], spec=..."
        )
    for name, given in (("bijectors", bijectors), ("spec", spec)):
        if given is not None:
            raise ValueError(
                f"{name}: expected none beside an environment, which states them, given both; "
                "leave one out"
            )
    published = constraint_bijectors(env)
    names = [bijector.name for bijector in published]
    if order is not None and list(order) != names:
        raise ValueError(
            f"order: expected the environment's own, {names}, given {list(order)}; state the "
            "priority once, in constrain_env(..., order=...)"
        )
    return _Statement(published, env.action_spec_unbatched)


def _own_spec(head: Any, action_key: NestedKey) -> TensorSpec | None:
    spec = getattr(head, "spec", None)
    return None if isinstance(spec, Composite) and spec[action_key] is None else spec


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
    """Tell whether an actor's actions have a log-density; projected ones have none."""
    head = actor_modules(actor)[-1]
    return head.flow.has_density if isinstance(head, ConstrainedFlowModule) else True


def actor_modules(actor: ProbabilisticTensorDictSequential) -> list[Any]:
    """Return the modules of an actor in order; the last one draws the action.

    Raises:
        TypeError: when the actor is no sequence that ends in a probabilistic module.
    """
    if not isinstance(actor, ProbabilisticTensorDictSequential):
        if isinstance(actor, nn.Module):
            refuse_exploration(actor)
        raise TypeError(
            "actor: expected a sequence that ends in a probabilistic module, such as a "
            f"ProbabilisticActor, given {type(actor).__name__}"
        )
    modules = actor.module
    return list(modules.values() if isinstance(modules, nn.ModuleDict) else modules)


def _parameter_keys(head: Any) -> list[NestedKey]:
    """Return the keys of location and scale; refuse a head that cannot be a flow's base."""
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
    if sorted(names) != [LOC_KEY, SCALE_KEY]:
        raise ValueError(
            "actor: expected a distribution that reads location and scale from the tensordict, "
            f"in_keys for 'loc' and 'scale', given {names}"
        )
    keys = dict(zip(names, head.in_keys, strict=True))
    return [keys[LOC_KEY], keys[SCALE_KEY]]


def _refuse_other_tanh_bounds(head: Any, bounds: Box) -> None:
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
    """Return a head's options besides its distribution, for a head that replaces it."""
    return {
        "return_log_prob": head.return_log_prob,
        "log_prob_key": head.log_prob_key,
        "default_interaction_type": head.default_interaction_type,
        "num_samples": head.num_samples,
    }
