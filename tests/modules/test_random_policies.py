"""Random actions within the constraints: alone, and before a learned policy."""

import copy
import pickle

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch._dynamo.testing import CompileCounter
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cnfp_torchrl.modules import SafeRandomPolicy, WarmUpPolicy, flow_head
from tests.point_nav import inside, make_actor, make_tanh_actor

AGENTS = 8


class Marked(nn.Module):
    """A network by whose location its steps are known."""

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        loc = torch.full_like(observation[..., :2], 0.125)
        return loc, torch.full_like(loc, 0.5)


def random_steps(rollout: TensorDictBase) -> list[bool]:
    """Which steps, over all agents, were taken at random."""
    by_network = (rollout["loc"] == 0.125).all(-1)
    at_random = (rollout["loc"] == 0).all(-1) & (rollout["scale"] == 1).all(-1)
    assert (by_network ^ at_random).all()
    assert (at_random == at_random[:1]).all()
    return at_random[0].tolist()


@pytest.mark.parametrize("flow", ["exact", "radial"])
def test_random_actions_are_inside_where_uniform_ones_are_not(
    env: TransformedEnv, state: TensorDictBase, flow: str
) -> None:
    many = state.expand(500, AGENTS).clone()
    for name, held in inside(SafeRandomPolicy(make_actor(flow=flow))(many)).items():
        assert held.all(), name
    uniform = [env.rand_action(state.clone())["action"] for _ in range(500)]
    results = inside(many.set("action", torch.stack(uniform)))
    assert not results["battery"].all()
    assert not results["obstacle"].all()


@pytest.mark.parametrize("exploration", [None, *ExplorationType], ids=str)
def test_it_is_random_under_every_exploration_type(
    state: TensorDictBase, exploration: ExplorationType | None
) -> None:
    policy = SafeRandomPolicy(make_actor())
    with set_exploration_type(exploration):
        first, second = (policy(state.clone())["action"] for _ in range(2))
    assert (first != second).all()


@pytest.mark.parametrize("return_log_prob", [False, True])
def test_declared_keys(state: TensorDictBase, return_log_prob: bool) -> None:
    policy = SafeRandomPolicy(make_actor(return_log_prob=return_log_prob))
    given = state.select(*policy.in_keys)
    out = policy(given)
    assert set(out.keys()) - {"constraints"} == set(policy.out_keys)
    assert ("action_log_prob" in policy.out_keys) == return_log_prob


def test_it_is_made_from_the_actor() -> None:
    for wrong in (flow_head(make_actor()), make_tanh_actor()):
        with pytest.raises(TypeError, match=r"actor: expected.*given"):
            SafeRandomPolicy(wrong)


# Warm-up ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frames", "steps"), [(0, 0), (1, 1), (8, 1), (9, 2), (24, 3), (10_000, 6)]
)
def test_it_switches_after_the_stated_frames(env: TransformedEnv, frames: int, steps: int) -> None:
    policy = WarmUpPolicy(make_actor(Marked()), frames)
    rollout = env.rollout(6, policy, break_when_any_done=False)
    assert random_steps(rollout) == [step < steps for step in range(6)]


def test_unbatched_environments_count_single_frames(state: TensorDictBase) -> None:
    policy = WarmUpPolicy(make_actor(Marked()), 2)
    assert [bool((policy(state[0].clone())["loc"] == 0).all()) for _ in range(4)] == [
        True,
        True,
        False,
        False,
    ]


@pytest.mark.parametrize("exploration", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
def test_every_step_is_alike_and_scored_by_what_drew_it(
    env: TransformedEnv, exploration: ExplorationType
) -> None:
    actor = make_actor(Marked(), return_log_prob=True)
    policy = WarmUpPolicy(actor, 3 * AGENTS)
    assert policy.in_keys == actor.in_keys
    assert policy.out_keys == actor.out_keys
    with set_exploration_type(exploration):
        rollout = env.rollout(6, policy, break_when_any_done=False)
    assert random_steps(rollout) == [True] * 3 + [False] * 3
    steps = [set(step.keys(True, True)) for step in rollout.unbind(-1)]
    assert all(keys == steps[0] for keys in steps)
    assert {"action", "loc", "scale", "action_log_prob"} <= steps[0]
    scored = flow_head(actor).get_dist(rollout).log_prob(rollout["action"])
    torch.testing.assert_close(rollout["action_log_prob"], scored, rtol=1e-2, atol=1e-2)
    assert all(held.all() for held in inside(rollout).values())
    assert rollout["next", "cost"].sum() == 0


def test_in_a_collector(env: TransformedEnv) -> None:
    # The collector tries its policy once, to learn its keys; that call counts too.
    policy = WarmUpPolicy(make_actor(Marked()), 4 * AGENTS)
    collector = Collector(
        env,
        policy,
        frames_per_batch=2 * AGENTS,
        total_frames=8 * AGENTS,
        auto_register_policy_transforms=False,
    )
    seen = [step for batch in collector for step in random_steps(batch)]
    assert seen == [True] * 3 + [False] * 5
    assert policy.frames_left <= 0


def test_counting_down_compiles_nothing_anew(state: TensorDictBase) -> None:
    torch._dynamo.reset()
    counter = CompileCounter()
    warm_up = WarmUpPolicy(make_actor(), 5 * state.numel())
    compiled = torch.compile(warm_up, backend=counter)
    counts = []
    with torch.no_grad():
        for _ in range(8):
            compiled(state.clone())
            counts.append(counter.frame_count)
    assert warm_up.frames_left == 0
    # Once for random actions, and once more for the actor's own.
    assert counts[0] == counts[4]
    assert counts[5] == counts[-1]


def test_copies_count_alone(state: TensorDictBase) -> None:
    policy = WarmUpPolicy(make_actor(), 20)
    copies = copy.deepcopy(policy), pickle.loads(pickle.dumps(policy))
    policy(state.clone())
    assert policy.frames_left == 12
    assert [twin.frames_left for twin in copies] == [20, 20]
    policy.frames_left = 20
    assert policy.frames_left == 20


def test_a_negative_number_of_frames_is_refused() -> None:
    with pytest.raises(ValueError, match="frames: expected a number >= 0, given -1"):
        WarmUpPolicy(make_actor(), -1)
