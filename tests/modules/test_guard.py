"""The last check of executed actions: it raises, it names, and it never repairs."""

import re

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from cnfp_torchrl.modules import (
    ConstraintViolationError,
    ExecutedActionGuard,
    RelaxedConstraintError,
    SafeRandomPolicy,
    flow_head,
    guarded,
)
from tests.point_nav import make_actor, make_tanh_actor

AGENT = 2


@pytest.fixture
def guard() -> ExecutedActionGuard:
    return ExecutedActionGuard(make_actor())


@pytest.fixture
def acted(env: TransformedEnv) -> TensorDictBase:
    """Safe actions in one state for all agents, beside the rectangle with little charge.

    Each set is left by some actions that are inside the two others.
    """
    state = env.reset(position=(0.35, 0.25), battery=28)
    return state.set("action", state["constraints", "anchor"].clone())


def set_action(acted: TensorDictBase, action: Tensor) -> TensorDictBase:
    changed = acted["action"].clone()
    changed[AGENT] = action
    return acted.set("action", changed)


def relaxed(acted: TensorDictBase, name: str, amount: float) -> TensorDictBase:
    """Widen one agent's set, as where the constraint cannot be had."""
    for key in ("relaxation", "row_relaxation"):
        if (entry := acted.get(("constraints", name, key), None)) is not None:
            entry[AGENT] = amount
    acted["constraints", name, "active"][AGENT] = amount == 0
    return acted


def just_beyond(bound: Tensor, towards: float) -> Tensor:
    return torch.nextafter(bound, torch.tensor(towards))


def obstacle_edge(acted: TensorDictBase) -> Tensor:
    """The leftmost allowed action, on the side of the station."""
    low = acted["constraints", "obstacle", "low"][AGENT]
    return torch.stack([low[0], torch.tensor(-0.9)])


def battery_edge(acted: TensorDictBase, inwards: float) -> Tensor:
    """An action near the edge of the battery's ball, away from the station."""
    ball = acted["constraints", "battery"][AGENT].double()
    way = torch.tensor([-0.4, 1.0]).double() - ball["center"]
    direction = way / torch.linalg.vector_norm(way)
    return (ball["center"] + direction * (ball["radius"] - inwards)).float()


BREAKING = {
    "bounds": lambda acted: just_beyond(torch.tensor([1.0, 0.0]), 2.0),
    "battery": lambda acted: battery_edge(acted, -1e-5),
    "obstacle": lambda acted: just_beyond(obstacle_edge(acted), -2.0),
}


def test_safe_actions_pass_untouched(guard: ExecutedActionGuard, acted: TensorDictBase) -> None:
    before, entries = acted.clone(), dict(acted.items(True, True))
    assert guard(acted) is acted
    after = dict(acted.items(True, True))
    assert after.keys() == entries.keys()
    assert all(after[key] is entries[key] for key in entries)
    assert (acted == before).all()


def test_actions_on_the_edge_pass(guard: ExecutedActionGuard, acted: TensorDictBase) -> None:
    for action in (torch.tensor([1.0, 0.0]), battery_edge(acted, 1e-5), obstacle_edge(acted)):
        guard(set_action(acted, action))


@pytest.mark.parametrize("name", BREAKING)
def test_one_bad_action_raises_and_stays_as_it_is(
    guard: ExecutedActionGuard, acted: TensorDictBase, name: str
) -> None:
    action = BREAKING[name](acted)
    set_action(acted, action)
    message = (
        re.escape(
            f"constraint '{name}': expected an action inside its set, given {action.tolist()}"
        )
        + r" with slack (?P<slack>\S+) at batch index "
        + re.escape(f"[{AGENT}]")
    )
    with pytest.raises(ConstraintViolationError, match=message) as caught:
        guard(acted)
    found = re.search(message, str(caught.value))
    assert found is not None
    assert -1e-4 < float(found["slack"]) < 0
    assert torch.equal(acted["action"][AGENT], action)


def test_an_action_of_nan_raises(guard: ExecutedActionGuard, acted: TensorDictBase) -> None:
    # Every comparison with it is false, so a check for "outside" would let it pass.
    with pytest.raises(ConstraintViolationError, match=r"'bounds'.*\[nan, 0\.0\] with slack nan"):
        guard(set_action(acted, torch.tensor([torch.nan, 0.0])))


@pytest.mark.parametrize("name", ["battery", "obstacle"])
def test_relaxed_constraints_are_asked_for_no_more_than_they_were_relaxed_to(
    guard: ExecutedActionGuard, acted: TensorDictBase, name: str
) -> None:
    set_action(acted, BREAKING[name](acted))
    guard(relaxed(acted, name, 1e-3))
    message = f"constraint '{name}': expected an action inside its set widened by 1e-09"
    with pytest.raises(ConstraintViolationError, match=message):
        guard(relaxed(acted, name, 1e-9))
    with pytest.raises(ConstraintViolationError, match=f"constraint '{name}'"):
        guard(relaxed(acted, name, 0.0))


def test_the_one_named_is_broken(guard: ExecutedActionGuard, acted: TensorDictBase) -> None:
    # An agent before it leaves another set, of lower priority, which is relaxed there.
    set_action(acted, BREAKING["battery"](acted))
    relaxed(acted, "battery", 1e-3)
    acted["action"][AGENT + 1] = BREAKING["obstacle"](acted)
    message = rf"constraint 'obstacle'.*batch index \[{AGENT + 1}\]"
    with pytest.raises(ConstraintViolationError, match=message):
        guard(acted)


@pytest.mark.parametrize("index", [(), (1, 2)], ids=["unbatched", "two batch dimensions"])
def test_the_index_has_the_batch_dimensions(
    guard: ExecutedActionGuard, acted: TensorDictBase, index: tuple[int, ...]
) -> None:
    one = acted[AGENT].clone()
    batched = one.expand(2, 3).clone() if index else one
    guard(batched)
    batched["action"][index] = torch.tensor([2.0, 0.0])
    with pytest.raises(ConstraintViolationError, match=re.escape(f"at batch index {list(index)}")):
        guard(batched)


@pytest.mark.parametrize("flow", ["exact", "radial"])
def test_guarded_exact_flows_run_through(env: TransformedEnv, flow: str) -> None:
    policy = guarded(make_actor(flow=flow))
    rollout = env.rollout(50, policy, break_when_any_done=False)
    assert rollout["next", "cost"].sum() == 0


def test_guarded_actors_are_really_guarded(state: TensorDictBase) -> None:
    # A fault behind the flow.
    actor = make_actor()
    policy = guarded(actor)
    policy(state.clone())
    actor.module[-1].register_forward_hook(
        lambda module, given, out: out.set("action", out["action"] + 3)
    )
    with pytest.raises(ConstraintViolationError, match="constraint 'bounds'"):
        policy(state)


@pytest.mark.parametrize("flow", ["squash", "unconstrained"])
def test_flows_without_a_guarantee_are_not_guarded(flow: str) -> None:
    actor = make_actor(flow=flow)
    assert guarded(actor) is actor


def test_declared_keys_are_enough(state: TensorDictBase) -> None:
    actor = make_actor()
    guard = ExecutedActionGuard(actor)
    SafeRandomPolicy(actor)(state)
    guard(state.select(*guard.in_keys))
    assert guard.out_keys == ["action"]


def test_a_guard_is_made_from_the_actor() -> None:
    for wrong in (flow_head(make_actor()), make_tanh_actor()):
        with pytest.raises(TypeError, match=r"actor: expected.*given"):
            ExecutedActionGuard(wrong)


@pytest.mark.parametrize(
    ("amount", "how"),
    [(0.25, "relaxed by 0.25"), (torch.inf, "dropped")],
    ids=["relaxed", "dropped"],
)
def test_relaxation_can_be_refused(acted: TensorDictBase, amount: float, how: str) -> None:
    strict = ExecutedActionGuard(make_actor(), refuse_relaxation=True)
    assert strict(acted) is acted
    # The action keeps even the set as stated.
    gave_way = relaxed(acted.clone(), "battery", amount)
    ExecutedActionGuard(make_actor())(gave_way.clone())
    message = rf"constraint 'battery': expected to hold.*it is {how} at batch index \[{AGENT}\]"
    with pytest.raises(RelaxedConstraintError, match=message):
        strict(gave_way)
    # A broken one is another error.
    with pytest.raises(ConstraintViolationError) as caught:
        strict(set_action(acted, BREAKING["battery"](acted)))
    assert not isinstance(caught.value, RelaxedConstraintError)


def test_refused_relaxation_reaches_the_guard_of_an_actor(state: TensorDictBase) -> None:
    policy = guarded(make_actor(), refuse_relaxation=True)
    policy(state.clone())
    with pytest.raises(RelaxedConstraintError, match="'obstacle'"):
        policy(relaxed(state, "obstacle", 0.1))
    with pytest.raises(ValueError, match=r"refuse_relaxation: expected False for SquashFlow"):
        guarded(make_actor(flow="squash"), refuse_relaxation=True)
