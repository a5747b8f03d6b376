"""The transform that publishes the anchor of the allowed actions and which constraints hold."""

import itertools
import re
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import (
    Compose,
    EnvBase,
    GymEnv,
    RewardSum,
    SerialEnv,
    TransformedEnv,
    check_env_specs,
)
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.envs import (
    ConstraintAnchor,
    ConstraintCost,
    GeometryTransform,
    constrain_env,
    constraint_bijectors,
)
from cnfp_torchrl.geometry import Ball, Box, ConstraintSet, GeometryError, HalfSpaces
from cnfp_torchrl.modules import ConstrainedFlowModule, ConstraintBijector, SafeRandomPolicy
from cnfp_torchrl.tasks.point_nav import (
    POINT_NAV_ID,
    BatteryGeometry,
    ObstacleGeometry,
    PointNavEnv,
)
from tests.copies import EVERY_COPY

ORDER = ["battery", "obstacle"]

# Of the anchor, on the reference layout: half of what a move along the way has.
LEAST_SLACK = 0.025


def with_anchor(
    base: EnvBase, *geometries: GeometryTransform, order: Sequence[str] | None = None
) -> TransformedEnv:
    env = TransformedEnv(base, Compose(*geometries))
    return env.append_transform(ConstraintAnchor(constraint_bijectors(env), order))


def point_nav(*batch_size: int, base: EnvBase | None = None) -> TransformedEnv:
    base = PointNavEnv(batch_size, seed=0) if base is None else base
    return with_anchor(base, ObstacleGeometry(), BatteryGeometry(), order=ORDER)


def slacks(state: TensorDictBase, action: Tensor) -> dict[str, Tensor]:
    """Slack of an action in each set: plain formulas in float64."""
    action = action.double()
    battery, obstacle = (state["constraints", name].double() for name in ORDER)
    distance = torch.linalg.vector_norm(action - battery["center"], dim=-1)
    room = torch.minimum(action - obstacle["low"], obstacle["high"] - action)
    return {
        "bounds": 1 - action.abs().amax(-1),
        "battery": battery["radius"] - distance,
        "obstacle": room.amin(-1),
    }


def flags(state: TensorDictBase) -> dict[str, Tensor]:
    return {name: state["constraints", name, "active"] for name in ORDER}


def safe_random_policy(env: TransformedEnv) -> SafeRandomPolicy:
    bijectors = constraint_bijectors(env)
    head = ConstrainedFlowModule(env.action_spec_unbatched, bijectors, order=ORDER)
    return SafeRandomPolicy(SafeProbabilisticTensorDictSequential(head))


# Specs --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("batch_size", [(), (1,), (3,), (2, 3)], ids=str)
def test_specs(batch_size: tuple[int, ...]) -> None:
    env = point_nav(*batch_size)
    env.append_transform(ConstraintCost())
    env.append_transform(RewardSum())
    check_env_specs(env)
    state = env.reset()
    assert state["constraints", "anchor"].shape == (*batch_size, 2)
    assert state["constraints", "anchor"].dtype == torch.float32
    for flag in flags(state).values():
        assert flag.shape == batch_size
        assert flag.dtype == torch.bool


def test_on_the_gymnasium_environment() -> None:
    env = point_nav(base=GymEnv(POINT_NAV_ID))
    env.auto_register_info_dict()
    env.set_seed(0)
    check_env_specs(env)
    rollout = env.rollout(60, safe_random_policy(env))
    assert rollout["next", "cost"].shape == (60, 2)
    assert rollout["next", "cost"].sum() == 0


@EVERY_COPY
def test_copies(copied: Callable[[TransformedEnv], TransformedEnv]) -> None:
    env = point_nav(3)
    state, other = env.reset(), copied(env)
    again = other.reset(position=state["observation"][:, :2], battery=[40, 70, 100])
    same = env.reset(position=state["observation"][:, :2], battery=[40, 70, 100])
    assert torch.equal(again["constraints", "anchor"], same["constraints", "anchor"])


def test_another_dtype_does_not_move_the_action_bounds() -> None:
    env = point_nav(3)
    env.reset()
    anchor = env.transform[-1]
    before = anchor.clone()
    anchor.half()
    assert not anchor.state_dict()
    state = env.reset()
    assert torch.equal(
        before(state.clone())["constraints", "anchor"], state["constraints", "anchor"]
    )


def test_a_clone_of_an_anchor_keeps_the_bounds_though_nothing_was_reset() -> None:
    env = point_nav(3)
    clone = env.transform[-1].clone()
    state = env.reset()
    assert torch.equal(
        clone(state.clone())["constraints", "anchor"], state["constraints", "anchor"]
    )


# Inside -------------------------------------------------------------------------------------------


def test_the_anchor_is_well_inside_along_rollouts() -> None:
    env = point_nav(200)
    rollout = env.rollout(150, safe_random_policy(env), break_when_any_done=False)
    for state in (rollout, rollout["next"]):
        for name, slack in slacks(state, state["constraints", "anchor"]).items():
            assert slack.min() >= LEAST_SLACK, name
        assert all(flag.all() for flag in flags(state).values())
    assert rollout["next", "cost"].sum() == 0
    least = torch.stack(list(slacks(rollout, rollout["constraints", "anchor"]).values())).amin()
    assert least < 0.2, "no state is tight: this shows little"


@pytest.mark.parametrize("battery", [21, 22, 24, 28])
def test_and_in_the_tightest_states_in_which_all_constraints_hold(battery: int) -> None:
    # On the edge of what the battery still reaches, on the way to the right station and beside it,
    # and pressed against rectangle and walls.
    reach = 0.9 * 0.1 + 0.09 * (battery - 20) - 1e-5
    x = torch.tensor([0.95 - reach, 0.95 - 0.6 * reach, 0.95 + 0.049, 0.95])
    y = torch.tensor([0.0, 0.8 * reach, 0.0, min(reach, 0.999)])
    position = torch.stack([x.clamp(min=0.3001), y], dim=-1)
    state = point_nav(4).reset(position=position, battery=battery)
    assert all(flag.all() for flag in flags(state).values())
    for name, slack in slacks(state, state["constraints", "anchor"]).items():
        assert slack.min() >= LEAST_SLACK, name


def test_a_wrong_candidate_does_no_harm() -> None:
    class WrongHint(BatteryGeometry):
        def safe_action(self, tensordict: TensorDictBase, allowed: ConstraintSet) -> Tensor:
            right = allowed.fields()["center"].clamp(-0.5, 0.5)
            wrong = torch.tensor([[-5.0, 5.0], [torch.nan, 0.0], [0.0, 1.0]])
            return torch.cat([wrong, right[3:]])

    env = with_anchor(PointNavEnv((6,), seed=0), ObstacleGeometry(), WrongHint(), order=ORDER)
    state = env.reset(position=(0.5, 0.6), battery=32)
    assert all(flag.all() for flag in flags(state).values())
    for name, slack in slacks(state, state["constraints", "anchor"]).items():
        assert slack.min() > 0.01, name


# Where a constraint cannot hold -------------------------------------------------------------------

UNHOLDABLE = {
    "in the rectangle": ({"position": (0.0, 0.0), "battery": 100}, {"obstacle"}),
    "on its edge": ({"position": (0.3, 0.1), "battery": 100}, {"obstacle"}),
    "charge at the threshold": ({"position": (0.6, 0.6), "battery": 20}, {"battery"}),
    "charge below it": ({"position": (0.6, 0.6), "battery": 3}, {"battery"}),
    "no charge": ({"position": (0.95, 0.0), "battery": 0}, {"battery"}),
    "out of reach of a station": ({"position": (0.6, 0.6), "battery": 23}, {"battery"}),
    "both": ({"position": (-0.1, 0.2), "battery": 20}, {"battery", "obstacle"}),
    "unconstrained": ({"position": (0.6, 0.6), "battery": 100}, set()),
}


@pytest.mark.parametrize(("chosen", "relaxed"), UNHOLDABLE.values(), ids=UNHOLDABLE)
@pytest.mark.parametrize("batch_size", [(), (3,)], ids=str)
def test_nothing_raises_and_the_flags_say_so(
    batch_size: tuple[int, ...], chosen: dict[str, Any], relaxed: set[str]
) -> None:
    env = point_nav(*batch_size)
    state = env.reset(**chosen)
    assert {name for name, flag in flags(state).items() if not flag.any()} == relaxed
    assert {name for name, flag in flags(state).items() if not flag.all()} == relaxed
    found = slacks(state, state["constraints", "anchor"])
    for name in {"bounds", *ORDER} - relaxed:
        assert found[name].min() > 5e-4, name
    for name in ORDER:
        amount = state["constraints", name, "relaxation"]
        assert (amount > 0).all() if name in relaxed else (amount == 0).all()
        assert amount.isfinite().all()
    # The flow acts there, inside of what holds, and the others give way by no more than they say.
    actions = [safe_random_policy(env)(state.clone())["action"] for _ in range(20)]
    for name in {"bounds", *ORDER} - relaxed:
        assert all(slacks(state, action)[name].min() >= 0 for action in actions), name
    for name in relaxed:
        least = -state["constraints", name, "relaxation"] * (1 + 1e-6)
        assert all((slacks(state, action)[name] >= least).all() for action in actions), name


def test_one_bad_state_does_not_touch_the_others() -> None:
    positions = torch.tensor([[0.6, 0.6], [0.0, 0.0], [0.31, 0.1]])
    env = point_nav(3)
    state = env.reset(position=positions, battery=[100, 100, 20])
    assert flags(state)["obstacle"].tolist() == [True, False, True]
    assert flags(state)["battery"].tolist() == [True, True, False]
    for i in range(3):
        alone = point_nav().reset(position=positions[i], battery=[100, 100, 20][i])
        for key in (("constraints", "anchor"), *(("constraints", n, "active") for n in ORDER)):
            torch.testing.assert_close(state[i][key], alone[key])


def test_uniform_actions_lead_anywhere_and_nothing_raises() -> None:
    env = point_nav(30)
    start = env.reset(battery=26)
    rollout = env.rollout(15, tensordict=start, auto_reset=False)
    held = flags(rollout["next"])
    found = slacks(rollout["next"], rollout["next", "constraints", "anchor"])
    assert found["bounds"].min() > 0
    for name, flag in held.items():
        assert not flag.all(), name
        assert found[name][flag].min() > 0, name


# Priority -----------------------------------------------------------------------------------------


class Side(GeometryTransform):
    """Allows moves to one side only."""

    def __init__(self, name: str, low: float, high: float) -> None:
        super().__init__(name)
        self.low, self.high = low, high

    def constraint_set(self, tensordict: TensorDictBase) -> Box:
        like = tensordict["observation"][..., :2]
        low, high = torch.full_like(like, -1), torch.full_like(like, 1)
        low[..., 0], high[..., 0] = self.low, self.high
        return Box(low, high, validate_args=False)


class Forward(GeometryTransform):
    """Allows moves upwards only, in the form of a half-space."""

    def constraint_set(self, tensordict: TensorDictBase) -> HalfSpaces:
        like = tensordict["observation"][..., :2]
        normals = torch.zeros_like(like).unsqueeze(-2)
        normals[..., 0, 1] = -1.0
        return HalfSpaces(normals, torch.full_like(like[..., :1], -0.5), validate_args=False)


@pytest.mark.parametrize(
    "order", list(itertools.permutations(["left", "right", "up"])), ids="-".join
)
@pytest.mark.parametrize("batch_size", [(), (4,)], ids=str)
def test_the_lower_of_two_that_exclude_each_other_is_dropped(
    order: tuple[str, ...], batch_size: tuple[int, ...]
) -> None:
    transforms = [Side("left", -1.0, -0.25), Side("right", 0.25, 1.0), Forward("up")]
    env = with_anchor(PointNavEnv(batch_size, seed=0), *transforms, order=order)
    state = env.reset()
    lower = min("left", "right", key=order.index)
    held = {name: state["constraints", name, "active"] for name in order}
    assert {name for name, flag in held.items() if flag.all()} == set(order) - {lower}
    assert not held[lower].any()
    x, y = state["constraints", "anchor"].unbind(-1)
    assert (x.sign() == (1 if lower == "left" else -1)).all()
    assert (x.abs() > 0.25).all()
    assert (y > 0.5).all()


def test_the_bijectors_own_order_is_the_default() -> None:
    for names in (["left", "right"], ["right", "left"]):
        sides = {"left": Side("left", -1.0, -0.25), "right": Side("right", 0.25, 1.0)}
        state = with_anchor(PointNavEnv((4,), seed=0), *(sides[name] for name in names)).reset()
        assert [bool(state["constraints", n, "active"].all()) for n in names] == [False, True]


@pytest.mark.parametrize(
    "order", [["battery"], ["battery", "obstacle", "wind"], ["battery", "battery"]], ids=str
)
def test_an_order_that_does_not_fit_is_refused(order: list[str]) -> None:
    with pytest.raises(ValueError, match=re.escape(f"exactly once, given {order}")):
        with_anchor(PointNavEnv(), ObstacleGeometry(), BatteryGeometry(), order=order)


# Other uses ---------------------------------------------------------------------------------------


def test_in_a_replay_buffer_it_fills_in_what_was_not_stored() -> None:
    env = point_nav(8)
    rollout = env.rollout(10, break_when_any_done=False).reshape(-1)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), batch_size=64)
    for transform in (ObstacleGeometry(), BatteryGeometry(), env.transform[-1].clone()):
        buffer.append_transform(transform)
    buffer.extend(rollout.exclude("constraints", ("next", "constraints")))
    sample = buffer.sample()
    for here in (sample, sample["next"]):
        stored = rollout if here is sample else rollout["next"]
        index = (here["observation"].unsqueeze(1) == stored["observation"]).all(-1).int().argmax(1)
        for key in (("constraints", "anchor"), *(("constraints", n, "active") for n in ORDER)):
            # Computed anew in a batch of another order and shape: up to rounding.
            torch.testing.assert_close(here[key], stored[key][index])


def test_transitions_without_a_next_state_are_fine() -> None:
    env = point_nav(8)
    state = env.reset()
    bare = state.exclude(("constraints", "anchor"))
    filled = env.transform[-1].clone()(bare)
    torch.testing.assert_close(filled["constraints", "anchor"], state["constraints", "anchor"])
    assert "next" not in filled.keys()  # noqa: SIM118 - a tensordict iterates over its batch


def test_outside_of_an_environment_it_says_what_it_needs() -> None:
    state = point_nav(3).reset()
    anchor = ConstraintAnchor([ConstraintBijector("battery", Ball)])
    with pytest.raises(RuntimeError, match="expected to be part of an environment"):
        anchor(state)


def test_a_missing_geometry_is_named() -> None:
    env = TransformedEnv(PointNavEnv((3,)), Compose(ObstacleGeometry()))
    env.append_transform(ConstraintAnchor([ConstraintBijector("battery", Ball)]))
    with pytest.raises(KeyError, match=r"\('constraints', 'battery', 'center'\)"):
        env.reset()


def test_sets_of_another_dimension_are_refused() -> None:
    class Flat(GeometryTransform):
        def constraint_set(self, tensordict: TensorDictBase) -> Ball:
            like = tensordict["observation"][..., :3]
            return Ball(torch.zeros_like(like), torch.ones_like(like[..., 0]), validate_args=False)

    env = with_anchor(PointNavEnv((3,)), Flat("flat"))
    with pytest.raises(GeometryError, match="'flat': expected a set of actions with 2 components"):
        env.reset()


def test_bijectors_are_those_of_the_geometries() -> None:
    env = point_nav(3)
    env.append_transform(RewardSum())
    bijectors = constraint_bijectors(env)
    assert [(bijector.name, bijector.set_type) for bijector in bijectors] == [
        ("battery", Ball),
        ("obstacle", Box),
    ]


def names(env: EnvBase) -> list[str]:
    return [bijector.name for bijector in constraint_bijectors(env)]


@pytest.mark.parametrize(
    "order", list(itertools.permutations(["left", "right", "up"])), ids="-".join
)
def test_bijectors_are_in_the_order_of_the_anchor(order: tuple[str, ...]) -> None:
    sides = [Side("left", -1.0, -0.25), Side("right", 0.25, 1.0), Forward("up")]
    assert names(constrain_env(PointNavEnv([2]), *sides, order=order)) == list(order)


def test_without_a_anchor_they_are_in_the_order_of_the_geometries() -> None:
    env = TransformedEnv(PointNavEnv([2]), Compose(ObstacleGeometry(), BatteryGeometry()))
    assert names(env) == ["obstacle", "battery"]


def test_geometries_are_found_however_deep_they_lie() -> None:
    nested = Compose(Compose(ObstacleGeometry()), BatteryGeometry())
    env = TransformedEnv(TransformedEnv(PointNavEnv([2]), nested), RewardSum(), auto_unwrap=False)
    assert names(env) == ["obstacle", "battery"]


def test_the_last_of_two_anchors_counts() -> None:
    once = constrain_env(PointNavEnv([2]), BatteryGeometry())
    assert names(constrain_env(once, ObstacleGeometry())) == ["battery", "obstacle"]


def test_an_environment_without_constraints_has_no_bijectors() -> None:
    without = TransformedEnv(PointNavEnv([2]), RewardSum())
    for env in (without, PointNavEnv([2])):
        message = f"at least one constraint, given {type(env).__name__} without a GeometryTransform"
        with pytest.raises(ValueError, match=message):
            constraint_bijectors(env)


@pytest.mark.parametrize("started", [False, True])
def test_nor_has_a_batch_of_environments_whose_transforms_are_in_workers(started: bool) -> None:
    batch = SerialEnv(2, point_nav)
    if started:
        batch.reset()
    for env in (batch, TransformedEnv(batch, RewardSum())):
        with pytest.raises(ValueError, match=r"before batching.*of a SerialEnv or ParallelEnv"):
            constraint_bijectors(env)
    batch.close(raise_if_closed=False)


def test_a_geometry_that_the_anchor_leaves_out_is_refused() -> None:
    env = constrain_env(PointNavEnv([2]), BatteryGeometry()).append_transform(ObstacleGeometry())
    with pytest.raises(ValueError, match=r"\['battery'\] that leaves out \['obstacle'\]"):
        constraint_bijectors(env)


def test_constrain_env_publishes_everything_the_actor_needs() -> None:
    base = TransformedEnv(PointNavEnv([3], seed=0), RewardSum())
    env = constrain_env(base, ObstacleGeometry(), BatteryGeometry(), order=ORDER)
    check_env_specs(env)
    assert names(env) == ORDER
    assert isinstance(base.transform, RewardSum)
    by_hand = TransformedEnv(
        PointNavEnv([3], seed=0), Compose(RewardSum(), BatteryGeometry(), ObstacleGeometry())
    )
    by_hand.append_transform(ConstraintAnchor(constraint_bijectors(by_hand)))
    for built in (env, by_hand):
        built.set_seed(3)
    given, expected = (built.reset()["constraints"] for built in (env, by_hand))
    assert (given == expected).all()
    with pytest.raises(ValueError, match="order: expected each of the constraints"):
        constrain_env(base, BatteryGeometry(), order=ORDER)


@pytest.mark.parametrize(
    ("wrong", "given"),
    [
        (BatteryGeometry, "the class BatteryGeometry"),
        ([BatteryGeometry()], "list"),
        (RewardSum(), "RewardSum"),
    ],
    ids=["class", "list", "other transform"],
)
def test_what_is_no_geometry_is_refused(wrong: Any, given: str) -> None:
    with pytest.raises(TypeError, match=f"expected each to be a GeometryTransform, given {given};"):
        constrain_env(PointNavEnv([2]), ObstacleGeometry(), wrong)


def test_constrain_env_needs_a_geometry_and_a_list_for_an_order() -> None:
    with pytest.raises(ValueError, match="geometries: expected at least one, given none"):
        constrain_env(PointNavEnv([2]))
    with pytest.raises(TypeError, match=r"order: .*given the string 'battery'"):
        constrain_env(PointNavEnv([2]), BatteryGeometry(), order="battery")


@pytest.mark.parametrize("wrong", [PointNavEnv, gymnasium.make("Pendulum-v1")])
def test_what_is_no_environment_is_refused(wrong: object) -> None:
    with pytest.raises(TypeError, match=r"env: expected a TorchRL environment, given .*GymWrapper"):
        constrain_env(wrong, BatteryGeometry())  # type: ignore[arg-type]
