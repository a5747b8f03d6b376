"""Batches of other shapes than the sets': what would be broadcast amiss is refused by name."""

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded

from cnfp_torchrl.envs import GeometryTransform, constrain_env
from cnfp_torchrl.geometry import Ball
from cnfp_torchrl.modules import (
    ConstrainedFlowModule,
    ConstraintBijector,
    ExecutedActionGuard,
    Flow,
    FlowMap,
    constrain,
    flow_head,
    make_constrained_actor,
)
from cnfp_torchrl.modules.flows import FLOWS
from cnfp_torchrl.tasks.point_nav import PointNavEnv
from cnfp_torchrl.training.networks import gaussian_network

STATES, DIM = 3, 2
READERS = [name for name, flow in FLOWS.items() if flow.reads_constraints]


def states(*batch: int) -> TensorDict:
    """A ball about another center in each state."""
    center = (
        torch.linspace(-0.5, 0.5, torch.Size(batch).numel())
        .reshape(*batch, 1)
        .repeat_interleave(DIM, -1)
    )
    constraints = {
        "limit": {
            "center": center,
            "radius": torch.full(batch, 0.2),
            "active": torch.ones(batch, dtype=torch.bool),
            "relaxation": torch.zeros(batch),
        },
        "anchor": center,
    }
    return TensorDict({"constraints": constraints}, batch[:1])


def head_of(flow: Flow | str) -> ConstrainedFlowModule:
    return ConstrainedFlowModule(
        Bounded(-1.0, 1.0, (DIM,)), [ConstraintBijector("limit", Ball)], flow=flow
    )


@pytest.mark.parametrize("flow", READERS)
@pytest.mark.parametrize("agents", [STATES, 1, 2])
def test_several_actions_for_one_set(flow: str, agents: int) -> None:
    state = states(STATES)
    state["loc"] = torch.zeros(STATES, agents, DIM)
    state["scale"] = torch.ones(STATES, agents, DIM)
    with pytest.raises(
        ValueError, match=rf"'loc'.*\({STATES},\).*given.*\({STATES}, {agents}, 2\)"
    ):
        head_of(flow)(state)
    state["latent"] = state["loc"]
    with pytest.raises(ValueError, match=r"'latent'.*each action needs a set of its own"):
        FlowMap(head_of(flow))(state)


@pytest.mark.parametrize("flow", READERS)
def test_each_agent_with_a_set_of_its_own(flow: str) -> None:
    state = states(STATES, STATES)
    state["loc"] = torch.zeros(STATES, STATES, DIM)
    state["scale"] = torch.ones(STATES, STATES, DIM)
    action = head_of(flow)(state)["action"]
    inside = Ball(state["constraints", "anchor"], torch.full((STATES, STATES), 0.2)).contains(
        action
    )
    assert inside.all()


def test_a_guard_does_not_compare_one_state_with_anothers_action() -> None:
    network = torch.nn.Linear(1, 2)
    actor = make_constrained_actor(
        network, bijectors=[ConstraintBijector("limit", Ball)], spec=Bounded(-1.0, 1.0, (DIM,))
    )
    state = states(STATES)
    # Agent j of every environment has an action of environment j's set.
    state["action"] = state["constraints", "anchor"].expand(STATES, STATES, DIM).clone()
    with pytest.raises(ValueError, match="'action'"):
        ExecutedActionGuard(actor)(state)


class Nested(PointNavEnv):
    """Point navigation whose action spec is one of several agents."""

    def __init__(self, batch: list[int], agents: int) -> None:
        super().__init__(batch)
        self.action_spec = Bounded(-1.0, 1.0, (*batch, agents, DIM))


class Limit(GeometryTransform):
    def constraint_set(self, tensordict: TensorDictBase) -> Ball:
        like = tensordict["observation"][..., :DIM]
        return Ball(torch.zeros_like(like), torch.ones_like(like[..., 0]), validate_args=False)


def test_actions_of_several_agents_are_refused_at_once() -> None:
    with pytest.raises(ValueError, match=r"one state's action, a vector of shape \(3, d\)"):
        constrain_env(Nested([STATES], STATES), Limit("limit"))


def test_a_batched_spec_is_refused() -> None:
    # Its target entropy would be that of all batch elements together, -64 d.
    env = constrain_env(PointNavEnv([64]), Limit("limit"))
    network = gaussian_network(5, 2, hidden=[4])
    bijectors = [ConstraintBijector("limit", Ball)]
    with pytest.raises(ValueError, match=r"pass env\.action_spec_unbatched"):
        make_constrained_actor(network, bijectors=bijectors, spec=env.action_spec)
    actor = make_constrained_actor(network, env)
    assert flow_head(actor).spec["action"].shape == (DIM,)
    with pytest.raises(ValueError, match=r"pass env\.action_spec_unbatched"):
        constrain(actor, spec=env.action_spec)
