"""The head of a constrained actor: what it reads, what it draws, and how that is scored."""

import copy
import re
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Bounded, Categorical, Composite, TensorSpec, Unbounded
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import NormalParamExtractor, ValueOperator
from torchrl.objectives import SACLoss

from cnfp_torchrl.bijectors import (
    BoxSquash,
    ExactSquash,
    GaugeSquash,
    NoDensityError,
    Projection,
    RadialSquash,
    Recession,
    SoftSquash,
    SquashChain,
)
from cnfp_torchrl.modules import (
    ConstrainedFlowModule,
    Flow,
    ProjectionFlow,
    SquashFlow,
    action_bounds,
    constrain,
    constraint_bijectors,
    flow_head,
    make_constrained_actor,
    with_reference_entropy,
)
from tests.copies import EVERY_COPY
from tests.point_nav import inside, make_actor

FLOWS = ["exact", "gauge", "soft", "recession", "radial", "squash", "unconstrained"]
NAMES = [*FLOWS[:5], "squash", "projection", "unconstrained"]
EXACT_FLOWS = ["exact", "gauge", "soft", "recession", "radial"]
SAFE_FLOWS = [*EXACT_FLOWS, "projection"]  # the last without a density
EXPLORATION_TYPES = [
    ExplorationType.RANDOM,
    ExplorationType.DETERMINISTIC,
    ExplorationType.MODE,
    ExplorationType.MEAN,
]


class Latent(nn.Module):
    """A network that always returns the same Gaussian, or a mean of random signs."""

    def __init__(self, loc: float, scale: float, *, signs: bool = False) -> None:
        super().__init__()
        self.loc, self.scale, self.signs = loc, scale, signs

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        loc = torch.full_like(observation[..., :2], self.loc)
        if self.signs:
            loc = loc * (2.0 * torch.randint(0, 2, loc.shape) - 1)
        return loc, torch.full_like(loc, self.scale)


LATENTS = {
    "at the middle": Latent(0.0, 1e-8),
    "of a new network": Latent(0.0, 1.0),
    "wide": Latent(0.0, 1e4),
    "saturated": Latent(1e6, 1e-8, signs=True),
    "saturated and wide": Latent(1e6, 1e4, signs=True),
    "just saturated": Latent(9.0, 1.0, signs=True),
}


def doubled(tensordict: TensorDictBase) -> TensorDictBase:
    return tensordict.apply(lambda value: value.double() if value.is_floating_point() else value)


# What it reads ------------------------------------------------------------------------------------


GEOMETRY = {"center", "radius", "low", "high"}
ANCHOR_ENTRIES = {"active", "relaxation", "row_relaxation", "anchor"}


@pytest.mark.parametrize(
    ("flow", "reads"),
    [
        ("exact", {*GEOMETRY, *ANCHOR_ENTRIES}),
        ("radial", {*GEOMETRY, *ANCHOR_ENTRIES}),
        ("projection", {*GEOMETRY, *ANCHOR_ENTRIES}),
        ("squash", GEOMETRY),
        ("unconstrained", set()),
    ],
)
def test_in_keys_are_what_the_flow_needs(state: TensorDictBase, flow: str, reads: set[str]) -> None:
    actor = make_actor(flow=flow)
    geometry = [key for key in actor.in_keys if key[0] == "constraints"]
    assert {key[-1] for key in geometry} == reads
    assert actor.in_keys[0] == "observation"
    out = actor(state.select(*actor.in_keys))
    assert set(out.keys()) - {"constraints"} == {"observation", "loc", "scale", "action"}


@pytest.mark.parametrize("flow", ["exact", "radial", "squash"])
def test_each_missing_entry_is_named(state: TensorDictBase, flow: str) -> None:
    actor = make_actor(flow=flow)
    for key in actor.in_keys[1:]:
        remedy = "ConstraintAnchor" if key[-1] in ANCHOR_ENTRIES else key[1]
        message = re.escape(f"expected {key}, found keys [") + f".*append.*{remedy}"
        with pytest.raises(KeyError, match=message):
            actor(state.exclude(key))


@pytest.mark.parametrize(
    ("flow", "kind"),
    [
        ("exact", ExactSquash),
        ("gauge", GaugeSquash),
        ("soft", SoftSquash),
        ("recession", Recession),
        ("radial", RadialSquash),
        ("squash", SquashChain),
        ("projection", Projection),
        ("unconstrained", BoxSquash),
        (SquashFlow(max_radius=0.5), SquashChain),
    ],
    ids=[*NAMES, "object"],
)
def test_flows_by_name_and_as_objects(state: TensorDictBase, flow: Flow | str, kind: type) -> None:
    head = flow_head(make_actor(flow=flow))
    assert type(head.get_bijector(state)) is kind
    assert head.flow is flow or isinstance(flow, str)


def test_an_unknown_flow_lists_the_choices() -> None:
    message = re.escape(f"flow: expected one of {NAMES} or a Flow, given 'gage'")
    with pytest.raises(ValueError, match=message):
        make_actor(flow="gage")


@pytest.mark.parametrize("radius", [0.0, -1.0, float("nan")])
def test_the_paper_chain_needs_a_radius(radius: float) -> None:
    with pytest.raises(ValueError, match="max_radius: expected a number > 0, given"):
        SquashFlow(max_radius=radius)


@pytest.mark.parametrize("rounds", [0, -3])
def test_the_projection_needs_rounds(rounds: int) -> None:
    with pytest.raises(ValueError, match="rounds: expected a number >= 1, given"):
        ProjectionFlow(rounds=rounds)


# What it draws ------------------------------------------------------------------------------------


@pytest.mark.parametrize("exploration", EXPLORATION_TYPES, ids=lambda mode: mode.name)
@pytest.mark.parametrize("latent", LATENTS.values(), ids=LATENTS)
@pytest.mark.parametrize("flow", SAFE_FLOWS)
def test_exact_flows_stay_inside_whatever_the_network(
    state: TensorDictBase, flow: str, latent: Latent, exploration: ExplorationType
) -> None:
    actor = make_actor(latent, flow=flow)
    many = state.expand(500, *state.shape).clone()
    with set_exploration_type(exploration):
        actor(many)
    assert many["action"].dtype == torch.float32
    for name, held in inside(many).items():
        assert held.all(), name


@pytest.mark.parametrize(
    ("flow", "held", "broken"),
    [
        pytest.param("squash", "obstacle", "battery", id="the last set of the paper's chain"),
        pytest.param("unconstrained", "bounds", "obstacle", id="the bounds alone"),
    ],
)
def test_the_other_flows_keep_what_they_promise_and_no_more(
    state: TensorDictBase, flow: str, held: str, broken: str
) -> None:
    many = state.expand(500, *state.shape).clone()
    results = inside(make_actor(LATENTS["of a new network"], flow=flow)(many))
    assert results[held].all()
    assert not results[broken].all(), "the states bind nothing: the tests above show little"


@pytest.mark.parametrize("flow", SAFE_FLOWS)
def test_a_constraint_that_cannot_hold_leaves_the_others(env: TransformedEnv, flow: str) -> None:
    # Inside the rectangle; the charge suffices for a part of the actions.
    state = env.reset(position=(0.0, 0.0), battery=28 + torch.arange(8) % 4)
    assert not state["constraints", "obstacle", "active"].any()
    many = state.expand(500, *state.shape).clone()
    results = inside(make_actor(LATENTS["wide"], flow=flow)(many))
    active = state["constraints", "battery", "active"]
    assert active.any()
    assert results["bounds"].all()
    assert results["battery"][:, active].all()
    assert not results["obstacle"].any()


@pytest.mark.parametrize("flow", FLOWS)
def test_stages_have_names_and_end_in_the_action(state: TensorDictBase, flow: str) -> None:
    for order in (["battery", "obstacle"], ["obstacle", "battery"]):
        head = flow_head(make_actor(flow=flow, order=order))
        expected = {"squash": order, "unconstrained": ["bounds"]}.get(flow, ["bounds", *order])
        assert head.order == order
        assert head.stage_names == expected
        latent = torch.randn(8, 2)
        stages = head.get_bijector(state).stages(latent)
        assert len(stages.actions) == len(expected)
        action, log_det = head.get_bijector(state).forward_and_log_det(latent)
        torch.testing.assert_close(stages.actions[-1], action)
        torch.testing.assert_close(stages.log_dets[-1], log_det)


def test_the_stage_of_a_constraint_is_inside_its_set(state: TensorDictBase) -> None:
    for order in (["battery", "obstacle"], ["obstacle", "battery"]):
        head = flow_head(make_actor(order=order))
        bijector = head.get_bijector(state.expand(500, *state.shape))
        actions = bijector.stages(3 * torch.randn(500, 8, 2)).actions
        for stage, constraint_set in enumerate(head.get_region(state).sets):
            assert constraint_set.contains(actions[stage:]).all()


def test_random_acts_on_noise_and_not_on_the_network(state: TensorDictBase) -> None:
    head = flow_head(make_actor(LATENTS["saturated"], return_log_prob=True))
    many = state.expand(500, *state.shape).clone()
    torch.manual_seed(1)
    # TorchRL would draw from the action spec here; and a deterministic mode must not silence noise.
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        head.random_sample(many)
    torch.manual_seed(1)
    torch.testing.assert_close(many["action"], head.get_bijector(many)(torch.randn(500, 8, 2)))
    for name, held in inside(many).items():
        assert held.all(), name
    assert (many["loc"] == 0).all()
    assert (many["scale"] == 1).all()
    torch.testing.assert_close(
        many["action_log_prob"],
        head.get_dist(many).log_prob(many["action"]),
        rtol=1e-2,
        atol=1e-2,
    )


# How that is scored -------------------------------------------------------------------------------


@pytest.mark.parametrize("flow", FLOWS)
def test_the_log_prob_written_is_that_of_the_action(state: TensorDictBase, flow: str) -> None:
    # In float64, where the inverse of the distribution's log_prob is good enough to tell.
    actor = make_actor(flow=flow, return_log_prob=True).double()
    out = actor(doubled(state))
    assert out["action_log_prob"].shape == (8,)
    density = flow_head(actor).get_dist(out)
    torch.testing.assert_close(
        out["action_log_prob"], density.log_prob(out["action"]), rtol=1e-7, atol=1e-7
    )
    torch.testing.assert_close(actor.log_prob(out), out["action_log_prob"], rtol=1e-7, atol=1e-7)


def test_saturated_samples_have_finite_log_probs(state: TensorDictBase) -> None:
    # Which the inverse could not give: it sees 1.0, where tanh of 12 and of 1000 are the same.
    actor = make_actor(Latent(12.0, 1.0), return_log_prob=True)
    assert actor(state)["action_log_prob"].isfinite().all()


def test_a_log_prob_key_of_ones_own(env: TransformedEnv, state: TensorDictBase) -> None:
    head = ConstrainedFlowModule(
        env.action_spec_unbatched,
        [],
        flow="unconstrained",
        return_log_prob=True,
        log_prob_key="score",
    )
    out = head(state.set("loc", torch.zeros(8, 2)).set("scale", torch.ones(8, 2)))
    assert head.out_keys == ["action", "score"]
    assert out["score"].shape == (8,)


def test_a_tensordict_for_the_output(state: TensorDictBase) -> None:
    out = make_actor()(state, tensordict_out=TensorDict(batch_size=[8]))
    assert set(out.keys()) == {"loc", "scale", "action"}
    assert "action" not in state.keys()  # noqa: SIM118 - a tensordict iterates over its batch


def test_the_projection_has_no_log_prob(state: TensorDictBase) -> None:
    with pytest.raises(ValueError, match="return_log_prob: expected False for ProjectionFlow"):
        make_actor(flow="projection", return_log_prob=True)
    actor = make_actor(flow="projection")
    with pytest.raises(NoDensityError, match="it has no density"):
        actor.get_dist(actor(state)).log_prob(state["action"])


def test_the_projection_agrees_with_tanh_where_nothing_binds(state: TensorDictBase) -> None:
    torch.manual_seed(1)
    projected = make_actor(flow="projection")(state.clone())["action"]
    torch.manual_seed(1)
    plain = make_actor(flow="unconstrained")(state.clone())
    allowed = flow_head(make_actor()).get_region(state).slack(plain["action"]) > 1e-4
    assert allowed.any()
    assert not allowed.all()
    torch.testing.assert_close(projected[allowed], plain["action"][allowed], rtol=0, atol=1e-5)
    moved = (projected - plain["action"]).norm(dim=-1)
    exact = make_actor(flow="exact")
    torch.manual_seed(1)
    assert (moved <= (exact(state.clone())["action"] - plain["action"]).norm(dim=-1) + 1e-4).all()


# Copies, devices, dtypes, compilation -------------------------------------------------------------


@pytest.mark.parametrize("flow", FLOWS)
@EVERY_COPY
def test_copies_act_alike_and_share_nothing(
    state: TensorDictBase, flow: str, copied: Callable[..., nn.Module]
) -> None:
    actor = make_actor(flow=flow)
    other = copied(actor)
    torch.manual_seed(1)
    expected = actor(state.clone())["action"]
    torch.manual_seed(1)
    assert torch.equal(other(state.clone())["action"], expected)
    mine = {tensor.data_ptr() for tensor in actor.parameters()}
    assert not mine & {tensor.data_ptr() for tensor in other.parameters()}
    assert flow_head(other).order == flow_head(actor).order


def test_state_dict_round_trip_holds_the_network_and_nothing_else(state: TensorDictBase) -> None:
    actor = make_actor()
    network = nn.Sequential(nn.Linear(5, 4), nn.ReLU())  # of another size
    other = copy.deepcopy(actor)
    for parameter in other.parameters():
        nn.init.normal_(parameter)
    assert not torch.equal(other(state.clone())["loc"], actor(state.clone())["loc"])
    other.load_state_dict(actor.state_dict())
    torch.manual_seed(1)
    expected = actor(state.clone())["action"]
    torch.manual_seed(1)
    assert torch.equal(other(state.clone())["action"], expected)
    assert len(actor.state_dict()) == len(list(actor.parameters()))
    with pytest.raises(RuntimeError, match="Missing key"):
        actor.load_state_dict(network.state_dict())


@pytest.mark.parametrize("flow", FLOWS)
def test_float64_all_the_way(state: TensorDictBase, flow: str) -> None:
    actor = make_actor(flow=flow, return_log_prob=True)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        single = actor(state.clone())["action"]
        actor.to(torch.float64)
        double = actor(doubled(state))
    assert double["action"].dtype == double["action_log_prob"].dtype == torch.float64
    torch.testing.assert_close(double["action"].float(), single, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("flow", SAFE_FLOWS)
def test_float64_actions_on_float32_geometry_survive_the_cast(
    state: TensorDictBase, flow: str
) -> None:
    actor = make_actor(LATENTS["saturated"], flow=flow).to(torch.float64)
    many = state.expand(500, *state.shape).clone()
    many["observation"] = many["observation"].double()
    many["action"] = actor(many)["action"].float()
    for name, held in inside(many).items():
        assert held.all(), name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("flow", SAFE_FLOWS)
def test_actions_on_float64_geometry_are_allowed(
    state: TensorDictBase, flow: str, dtype: torch.dtype
) -> None:
    """Observations of float64, as Gymnasium's MuJoCo environments give, under a float32 spec."""
    actor = make_actor(LATENTS["saturated"], flow=flow)
    many = doubled(state).expand(500, *state.shape).clone()
    many["observation"] = many["observation"].to(dtype)
    for value in many["constraints"].values(include_nested=True, leaves_only=True):
        if value.is_floating_point():
            value.mul_(1 + 5e-8 * torch.rand_like(value))
    assert actor(many)["action"].dtype == dtype
    assert all(held.all() for held in inside(many).values())
    many["action"] = many["action"].float()
    assert all(held.all() for held in inside(many).values())


def test_moving_to_a_device_takes_the_bounds_along() -> None:
    head = flow_head(make_actor())
    where = TensorDict(device="meta").set("loc", torch.zeros(2))
    assert (
        ConstrainedFlowModule(head.spec, [], flow="unconstrained")
        .get_bijector(where)
        .image.low.is_meta
    )


@pytest.mark.parametrize(
    "change",
    [
        lambda module: module.half(),
        lambda module: module.bfloat16(),
        lambda module: module.double(),
        lambda module: module.to(torch.float16),
        lambda module: module.to("meta").to_empty(device="cpu"),
        lambda module: module.apply(lambda part: part._apply(lambda tensor: tensor * 2)),
    ],
)
def test_nothing_else_changes_the_bounds(change: Callable[..., nn.Module]) -> None:
    # 0.1 lies beyond its float16 and bfloat16 neighbors.
    head = ConstrainedFlowModule(Bounded(-0.1, 0.1, (2,)), [])
    before = head.bounds
    change(head)
    assert torch.equal(head.bounds.low, before.low)
    assert torch.equal(head.bounds.high, before.high)


def test_a_checkpoint_of_another_actors_loss_leaves_the_bounds_alone(env: TransformedEnv) -> None:
    def loss_of(spec: TensorSpec) -> SACLoss:
        network = nn.Sequential(nn.Linear(5, 4), NormalParamExtractor())
        actor = make_constrained_actor(
            network, bijectors=constraint_bijectors(env), spec=spec, flow="exact"
        )
        value = ValueOperator(nn.Linear(7, 1), in_keys=["observation", "action"])
        return SACLoss(actor, value, action_spec=spec)

    wide, narrow = loss_of(Bounded(-3.0, 3.0, (2,))), loss_of(Bounded(-0.1, 0.1, (2,)))
    narrow.load_state_dict(wide.state_dict())
    assert flow_head(narrow.actor_network).bounds.high.tolist() == pytest.approx([0.1, 0.1])
    assert not any("bound" in key for key in narrow.state_dict())


def test_the_compiled_actor_is_one_graph_and_acts_alike(state: TensorDictBase) -> None:
    torch._dynamo.reset()
    actor = make_actor()
    compiled = torch.compile(actor, backend="aot_eager", fullgraph=True)
    with torch.no_grad():
        torch.manual_seed(1)
        expected = actor(state.clone())["action"]
        torch.manual_seed(1)
        # A compiler may fuse operations, which then round differently.
        torch.testing.assert_close(compiled(state.clone())["action"], expected)


# The action spec ----------------------------------------------------------------------------------

CONTINUOUS = "expected a continuous spec of vectors with bounds on both sides"


@pytest.mark.parametrize(
    ("spec", "key"),
    [
        (Bounded(-1, 2.0, (3,)), "action"),
        (Composite(action=Bounded(-1, 2.0, (4, 2, 3)), shape=(4, 2)), "action"),
        (Composite(action=Bounded(-1, 2.0, (3,))), "action"),
        (Composite(agent=Composite(move=Bounded(-1, 2.0, (3,)))), ("agent", "move")),
        (Bounded(torch.tensor([-1.0, -1.0, -1.0]), torch.tensor([2.0, 2.0, 2.0])), "action"),
    ],
    ids=["plain", "batched", "composite", "nested", "tensors"],
)
def test_action_bounds_are_one_box(spec: TensorSpec, key: str | tuple[str, ...]) -> None:
    bounds = action_bounds(spec, key)
    assert bounds.low.tolist() == [-1, -1, -1]
    assert bounds.high.tolist() == [2, 2, 2]


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        pytest.param(Unbounded((3,)), f"{CONTINUOUS}.*UnboundedContinuous", id="unbounded"),
        pytest.param(Bounded(-1, torch.inf, (3,)), CONTINUOUS, id="open above"),
        pytest.param(Bounded(-torch.inf, 1, (3,)), CONTINUOUS, id="open below"),
        pytest.param(Categorical(3), f"{CONTINUOUS}.*given Categorical", id="categories"),
        pytest.param(Bounded(-1, 1.0, ()), CONTINUOUS, id="no vector"),
        pytest.param(Bounded(0, 3, (2,), dtype=torch.int64), CONTINUOUS, id="whole numbers"),
        pytest.param(
            Bounded(-1, torch.tensor([[1.0, 1.0], [1.0, 2.0]]), (2, 2)),
            "expected that of one state's action.*action_spec_unbatched",
            id="different in a batch",
        ),
        pytest.param(Bounded(-1, 1.0, (64, 2)), "expected that of one state", id="batched"),
    ],
)
def test_specs_without_such_a_box_are_refused(spec: TensorSpec, message: str) -> None:
    with pytest.raises(ValueError, match=f"spec of 'action': {message}"):
        action_bounds(spec)
    with pytest.raises(ValueError, match=f"spec of 'action': {message}"):
        make_constrained_actor(nn.Identity(), spec=spec, bijectors=[])


def test_views_and_composition_keep_options() -> None:
    actor = make_actor(flow="radial", order=["obstacle", "battery"], return_log_prob=True)
    view, again = with_reference_entropy(actor), constrain(actor, flow="radial")
    for other in (flow_head(view), flow_head(again)):
        head = flow_head(actor)
        assert other.order == head.order
        assert type(other.flow) is type(head.flow)
        assert other.out_keys == head.out_keys
        assert other.in_keys == head.in_keys
        assert other.default_interaction_type is head.default_interaction_type
