"""Constraining an actor that exists: what changes, what stays, and what is refused."""

import re
from collections import OrderedDict
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
    set_skip_existing,
)
from torch import nn
from torchrl.data import Bounded
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import (
    ActorValueOperator,
    Delta,
    IndependentNormal,
    ProbabilisticActor,
    TanhDelta,
    TanhNormal,
    TruncatedNormal,
    ValueOperator,
)

from cnfp_torchrl.envs import constrain_env
from cnfp_torchrl.geometry import Ball
from cnfp_torchrl.modules import (
    ConstrainedFlowModule,
    ConstraintBijector,
    GaugeFlow,
    ParameterNetwork,
    constrain,
    flow_head,
    guarded,
    make_constrained_actor,
    with_reference_entropy,
)
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from tests.point_nav import BIJECTORS, inside, make_actor, make_network, make_tanh_actor

# Of the box squash, whose bounds are moved inwards by 16 rounding errors (`Box.eroded`).
EROSION = 16 * torch.finfo(torch.float32).eps


@pytest.fixture
def unbound(state: TensorDictBase) -> TensorDictBase:
    """States in which no constraint binds: the sets are as wide as the action bounds allow."""
    state["constraints", "battery", "radius"] = torch.full((8,), 1e3)
    state["constraints", "obstacle", "low"] = torch.full((8, 2), -2.0)
    state["constraints", "obstacle", "high"] = torch.full((8, 2), 2.0)
    return state


def act(actor: nn.Module, state: TensorDictBase) -> TensorDictBase:
    torch.manual_seed(1)
    with set_exploration_type(ExplorationType.RANDOM):
        return actor(state.clone())


# What changes and what stays ----------------------------------------------------------------------


def test_without_binding_constraints_a_tanh_actor_is_unchanged(unbound: TensorDictBase) -> None:
    # A second tanh would move the action by up to 1 - tanh(1) = 0.24.
    actor = make_tanh_actor(return_log_prob=True)
    many = unbound.expand(100, 8).clone()
    expected, got = act(actor, many), act(constrain(actor, bijectors=BIJECTORS), many)
    assert expected["action"].abs().max() > 0.9
    torch.testing.assert_close(got["action"], expected["action"], rtol=0, atol=2 * EROSION)
    torch.testing.assert_close(
        got["action_log_prob"], expected["action_log_prob"], rtol=1e-3, atol=1e-3
    )


def test_an_independent_normal_becomes_the_base(unbound: TensorDictBase) -> None:
    actor = make_tanh_actor(distribution_class=IndependentNormal)
    latent, got = (
        act(actor, unbound)["action"],
        act(constrain(actor, bijectors=BIJECTORS), unbound),
    )
    torch.testing.assert_close(got["action"], latent.tanh(), rtol=0, atol=2 * EROSION)


@pytest.mark.parametrize("flow", ["exact", "radial"])
@pytest.mark.parametrize("distribution", [TanhNormal, IndependentNormal])
def test_constraints_hold_that_did_not(
    state: TensorDictBase, distribution: type, flow: str
) -> None:
    actor = make_tanh_actor(distribution_class=distribution)
    many = state.expand(500, 8).clone()
    before = inside(act(actor, many))
    after = inside(act(constrain(actor, bijectors=BIJECTORS, flow=flow), many))
    for name in ("battery", "obstacle"):
        assert not before[name].all()
        assert after[name].all()


def test_networks_are_shared(state: TensorDictBase) -> None:
    network = make_network()
    actor = make_tanh_actor(network)
    constrained = constrain(actor, bijectors=BIJECTORS)
    assert [id(p) for p in constrained.parameters()] == [id(p) for p in network.parameters()]
    before = actor(state.clone())["loc"]
    constrained(state.clone())["action"].sum().backward()
    for parameter in constrained.parameters():
        parameter.data -= parameter.grad
    assert not torch.equal(actor(state.clone())["loc"], before)


def test_a_checkpoint_of_the_actor_fits_the_constrained_one() -> None:
    actor = make_tanh_actor()
    assert constrain(actor, bijectors=BIJECTORS).state_dict().keys() == actor.state_dict().keys()


def test_the_actor_itself_is_left_alone(state: TensorDictBase) -> None:
    actor = make_tanh_actor()
    before = act(actor, state)["action"]
    constrain(actor, bijectors=BIJECTORS)
    assert type(actor.get_dist(state.clone())) is TanhNormal
    assert torch.equal(act(actor, state)["action"], before)


@pytest.mark.parametrize(
    ("in_keys", "out_key", "log_prob_key"),
    [
        (["loc", "scale"], "action", "action_log_prob"),
        ([("agent", "loc"), ("agent", "scale")], ("agent", "move"), ("agent", "move_log_prob")),
        (["scale", "loc"], "action", "score"),
        ({"loc": "mean", "scale": "deviation"}, "move", "move_log_prob"),
        ({"scale": ("p", "deviation"), "loc": ("p", "mean")}, "action", "action_log_prob"),
    ],
    ids=["usual", "nested", "swapped", "renamed", "renamed and swapped"],
)
def test_keys_stay(unbound: TensorDictBase, in_keys: Any, out_key: Any, log_prob_key: Any) -> None:
    names = in_keys if isinstance(in_keys, dict) else dict(zip(("a", "b"), in_keys, strict=True))
    if not isinstance(in_keys, dict):
        names = {key if isinstance(key, str) else key[-1]: key for key in in_keys}
    out_keys = [names["loc"], names["scale"]]
    body = TensorDictModule(make_network(), in_keys=["obs"], out_keys=out_keys)
    actor = ProbabilisticActor(
        body,
        in_keys=in_keys,
        out_keys=[out_key],
        spec=Bounded(-1, 1, (2,)),
        distribution_class=TanhNormal,
        return_log_prob=True,
        log_prob_key=log_prob_key,
    )
    constrained = constrain(actor, bijectors=BIJECTORS)
    assert constrained.in_keys[0] == "obs"
    assert set(constrained.out_keys) == set(actor.out_keys)
    state = unbound.set("obs", unbound["observation"])
    expected, got = act(actor, state), act(constrained, state)
    torch.testing.assert_close(got[out_key], expected[out_key], rtol=0, atol=2 * EROSION)
    torch.testing.assert_close(got[log_prob_key], expected[log_prob_key], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("kind", [InteractionType.RANDOM, InteractionType.DETERMINISTIC], ids=str)
def test_the_default_interaction_type_stays(state: TensorDictBase, kind: InteractionType) -> None:
    actor = constrain(make_tanh_actor(default_interaction_type=kind), bijectors=BIJECTORS)
    repeats = torch.equal(actor(state.clone())["action"], actor(state.clone())["action"])
    assert repeats == (kind is InteractionType.DETERMINISTIC)


def test_several_samples_at_once(state: TensorDictBase) -> None:
    actor = make_tanh_actor(num_samples=3, default_interaction_type=InteractionType.RANDOM)
    assert constrain(actor, bijectors=BIJECTORS)(state)["action"].shape == (3, 8, 2)


@pytest.mark.parametrize(
    ("order", "expected"),
    [(None, ["battery", "obstacle"]), (["obstacle", "battery"], ["obstacle", "battery"])],
)
def test_order(order: list[str] | None, expected: list[str]) -> None:
    assert (
        flow_head(constrain(make_tanh_actor(), bijectors=BIJECTORS, order=order)).order == expected
    )


# Actors of other shapes ---------------------------------------------------------------------------


def test_a_policy_that_shares_its_body_with_a_critic(unbound: TensorDictBase) -> None:
    body = TensorDictModule(nn.Linear(5, 5), in_keys=["observation"], out_keys=["observation"])
    value = ValueOperator(nn.Linear(5, 1), in_keys=["observation"])
    shared = ActorValueOperator(body, make_tanh_actor(), value)
    actor = shared.get_policy_operator()
    constrained = constrain(actor, bijectors=BIJECTORS)
    expected, got = act(actor, unbound), act(constrained, unbound)
    torch.testing.assert_close(got["action"], expected["action"], rtol=0, atol=2 * EROSION)
    assert {id(parameter) for parameter in constrained.parameters()} == {
        id(p) for p in actor.parameters()
    }


def test_an_actor_with_named_modules(unbound: TensorDictBase) -> None:
    body = TensorDictModule(make_network(), in_keys=["observation"], out_keys=["loc", "scale"])
    head = ProbabilisticTensorDictModule(
        ["loc", "scale"], ["action"], distribution_class=TanhNormal
    )
    actor = ProbabilisticTensorDictSequential(OrderedDict(body=body, head=head))
    constrained = constrain(actor, bijectors=BIJECTORS, spec=Bounded(-1, 1, (2,)))
    expected, got = act(actor, unbound), act(constrained, unbound)
    torch.testing.assert_close(got["action"], expected["action"], rtol=0, atol=2 * EROSION)


def test_constraining_twice_keeps_both(state: TensorDictBase) -> None:
    battery, obstacle = BIJECTORS
    once = constrain(make_tanh_actor(), bijectors=[battery], flow="radial")
    twice = constrain(once, bijectors=[obstacle])
    assert flow_head(once).order == ["battery"]
    assert flow_head(twice).order == ["battery", "obstacle"]
    both = constrain(make_tanh_actor(), bijectors=[battery, obstacle])
    assert torch.equal(act(twice, state)["action"], act(both, state)["action"])
    turned = constrain(once, bijectors=[obstacle], order=["obstacle", "battery"])
    assert flow_head(turned).order == ["obstacle", "battery"]
    with pytest.raises(ValueError, match=r"battery.* more than once"):
        constrain(once, bijectors=[battery])


def test_constraining_again_may_change_the_flow_alone() -> None:
    actor = constrain(make_tanh_actor(), bijectors=BIJECTORS)
    again = constrain(actor, flow="gauge", order=["obstacle", "battery"])
    assert isinstance(flow_head(again).flow, GaugeFlow)
    assert flow_head(again).order == ["obstacle", "battery"]


def test_the_order_is_the_environments() -> None:
    order = ["obstacle", "battery"]
    env = constrain_env(PointNavEnv([8]), BatteryGeometry(), ObstacleGeometry(), order=order)
    assert flow_head(constrain(make_tanh_actor(), env)).order == order


# What is refused ----------------------------------------------------------------------------------


def test_an_actor_cannot_be_constrained_by_nothing() -> None:
    with pytest.raises(ValueError, match=r"bijectors: expected at least one.*given none"):
        constrain(make_tanh_actor())


def test_what_is_no_environment_or_bijector_is_refused(env: TransformedEnv) -> None:
    for other in (BIJECTORS, BIJECTORS[0], env.action_spec_unbatched):
        with pytest.raises(TypeError, match=f"env: .*given {type(other).__name__}.*bijectors="):
            constrain(make_tanh_actor(), other)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"bijectors: expected a sequence of Constr.*with a list"):
        constrain(make_tanh_actor(), bijectors=[BIJECTORS])  # type: ignore[list-item]


@pytest.mark.parametrize("make", [constrain, make_constrained_actor], ids=lambda f: f.__name__)
@pytest.mark.parametrize("stated", ["bijectors", "spec", "order"])
def test_two_statements_are_refused(env: TransformedEnv, make: Any, stated: str) -> None:
    second = {
        "bijectors": BIJECTORS,
        "spec": env.action_spec_unbatched,
        "order": ["obstacle", "battery"],
    }
    given = make_tanh_actor() if make is constrain else make_network()
    with pytest.raises(ValueError, match=f"^{stated}: "):
        make(given, env, **{stated: second[stated]})
    assert flow_head(make(given, env, order=["battery", "obstacle"])).order == [
        bijector.name for bijector in BIJECTORS
    ]


def test_neither_environment_nor_what_takes_its_place() -> None:
    with pytest.raises(ValueError, match=r"^bijectors: .*nor bijectors"):
        make_constrained_actor(make_network())
    with pytest.raises(ValueError, match=r"^spec: .*nor spec"):
        make_constrained_actor(make_network(), bijectors=BIJECTORS)


def test_an_actor_with_other_bounds_than_its_environments(env: TransformedEnv) -> None:
    twice = {"spec": Bounded(-2.0, 2.0, (2,)), "distribution_kwargs": {"low": -2.0, "high": 2.0}}
    normal = {"spec": Bounded(-2.0, 2.0, (2,)), "distribution_class": IndependentNormal}
    for options in (twice, normal):
        actor = make_tanh_actor(**options)
        for other in (actor, constrain(actor, bijectors=BIJECTORS)):
            with pytest.raises(ValueError, match=re.escape("given low [-2.0, -2.0]")):
                constrain(other, env)


def test_a_constrained_actor_takes_its_constraints_from_the_environment_again(
    env: TransformedEnv,
) -> None:
    obstacle_alone = constrain(make_tanh_actor(), bijectors=BIJECTORS[1:])
    assert flow_head(constrain(obstacle_alone, env)).order == ["battery", "obstacle"]
    unknown = constrain(make_tanh_actor(), bijectors=[ConstraintBijector("speed", Ball)])
    with pytest.raises(ValueError, match=re.escape("without ['speed']")):
        constrain(unknown, env)


def test_a_string_is_no_sequence_of_names(env: TransformedEnv) -> None:
    message = re.escape("order: expected a sequence of names, given the string 'battery'; write")
    with pytest.raises(TypeError, match=message):
        constrain(make_tanh_actor(), bijectors=BIJECTORS[:1], order="battery")
    spec = env.action_spec_unbatched
    with pytest.raises(TypeError, match=message):
        make_constrained_actor(make_network(), spec=spec, bijectors=BIJECTORS[:1], order="battery")
    with pytest.raises(TypeError, match=re.escape("write in_keys=['observation']")):
        make_constrained_actor(make_network(), env, in_keys="observation")


@pytest.mark.parametrize(
    "distribution",
    [TruncatedNormal, TanhDelta, Delta, torch.distributions.Normal],
    ids=lambda kind: kind.__name__,
)
def test_other_distributions_are_refused(distribution: type) -> None:
    message = f"expected TanhNormal or IndependentNormal.*given {distribution.__name__}; end"
    with pytest.raises(TypeError, match=message):
        constrain(make_tanh_actor(distribution_class=distribution))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        pytest.param({"distribution_kwargs": {"tanh_loc": True}}, "tanh_loc=True", id="moved loc"),
        pytest.param({"distribution_kwargs": {"event_dims": 0}}, "event_dims = 1, given 0", id="0"),
        pytest.param(
            {"in_keys": ["loc"], "distribution_kwargs": {"scale": 0.1}},
            "in_keys for 'loc' and 'scale', given ['loc']",
            id="fixed scale",
        ),
        pytest.param(
            {"in_keys": {"loc": "loc", "scale": "scale", "upscale": "u"}},
            "given ['loc', 'scale', 'upscale']",
            id="third parameter",
        ),
        pytest.param({"spec": None}, "the actor has none; pass", id="no spec"),
        pytest.param(
            {"distribution_kwargs": {"low": -0.5, "high": 1.0}},
            "spec's low [-1.0, -1.0], given -0.5; build it with distribution_kwargs={'low': ",
            id="tighter TanhNormal",
        ),
        pytest.param(
            {"spec": Bounded(-1, 2.0, (2,))}, "spec's high [2.0, 2.0], given 1.0", id="wider spec"
        ),
    ],
)
def test_what_would_change_silently_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        constrain(make_tanh_actor(**options), bijectors=BIJECTORS)


def test_a_spec_can_be_handed_in(state: TensorDictBase) -> None:
    actor = make_tanh_actor(spec=None)
    constrained = constrain(actor, bijectors=BIJECTORS, spec=Bounded(-1, 1, (2,)))
    assert constrained(state)["action"].shape == (8, 2)


def test_bounds_of_the_tanh_normal_may_be_tensors() -> None:
    spec = Bounded(torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 3.0]))
    limits = {"low": spec.space.low, "high": spec.space.high}
    head = flow_head(
        constrain(make_tanh_actor(spec=spec, distribution_kwargs=limits), bijectors=BIJECTORS)
    )
    assert head.bounds.low.tolist() == [-1, 0]
    assert head.bounds.high.tolist() == [1, 3]


def test_what_is_no_actor_is_refused() -> None:
    network = make_network()
    body = TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"])
    for other in (network, body, TensorDictSequential(body)):
        with pytest.raises(TypeError, match=f"actor: expected.*given {type(other).__name__}"):
            constrain(other, bijectors=[ConstraintBijector("limit", Ball)])  # type: ignore[arg-type]


def test_what_is_not_constrained_has_no_flow() -> None:
    for needs_a_flow in (flow_head, with_reference_entropy, guarded):
        with pytest.raises(TypeError, match="expected one that ends in a ConstrainedFlowModule"):
            needs_a_flow(make_tanh_actor())


def test_the_head_is_the_flow_module() -> None:
    actor = make_actor()
    assert flow_head(actor) is actor.module[-1]
    assert isinstance(flow_head(actor), ConstrainedFlowModule)


def test_a_network_is_called_as_tensordicts_module_calls_it() -> None:
    network = torch.nn.Linear(3, 2)
    both = lambda x: (network(x), network(x).exp())  # noqa: E731 - a network without a module
    ours = ParameterNetwork(both, in_keys=["x"], out_keys=["loc", "scale"])
    theirs = TensorDictModule(both, in_keys=["x"], out_keys=["loc", "scale"])
    x = torch.randn(4, 3)
    expected, given = (policy(TensorDict({"x": x}, batch_size=4)) for policy in (theirs, ours))
    assert set(given.keys()) == set(expected.keys())
    for key in expected.keys():  # noqa: SIM118 - a tensordict iterates over its batch
        assert torch.equal(given[key], expected[key])
    for one, other in zip(ours(x), theirs(x), strict=True):  # by dispatch
        assert torch.equal(one, other)
    with set_skip_existing(True):
        kept = ours(TensorDict({"x": x, "loc": x, "scale": x}, batch_size=4))
    assert torch.equal(kept["loc"], x)
    with pytest.raises(KeyError, match="x"):
        ours(TensorDict({}, batch_size=4))
    with pytest.raises(RuntimeError):
        ParameterNetwork(network, in_keys=["x"], out_keys=["loc", "scale"])(
            TensorDict({"x": x}, batch_size=4)
        )
