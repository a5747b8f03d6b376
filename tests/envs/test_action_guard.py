"""The transform that executes no action that breaks a constraint, whoever chose it."""

import copy
from collections.abc import Callable
from functools import partial

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import (
    ActionScaling,
    Compose,
    EnvBase,
    GymEnv,
    RewardSum,
    SerialEnv,
    TransformedEnv,
    check_env_specs,
)
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.envs import ActionGuard, constrain_env
from cnfp_torchrl.modules import (
    ConstraintViolationError,
    RelaxedConstraintError,
    make_constrained_actor,
)
from cnfp_torchrl.tasks.point_nav import (
    POINT_NAV_ID,
    BatteryGeometry,
    ObstacleGeometry,
    PointNavEnv,
)
from cnfp_torchrl.training.networks import gaussian_network
from tests.copies import EVERY_COPY
from tests.walls import HOLDS, MISSED, Wall, Walls, Window, walls

AGENTS = 16


def constrained(*batch_size: int, base: EnvBase | None = None, steps: int = 17) -> TransformedEnv:
    base = PointNavEnv(batch_size, max_steps=steps, seed=0) if base is None else base
    return constrain_env(base, BatteryGeometry(), ObstacleGeometry())


def guarded_env(*batch_size: int, steps: int = 17) -> TransformedEnv:
    return constrained(*batch_size, steps=steps).append_transform(ActionGuard())


def untrained_actor(env: TransformedEnv) -> SafeProbabilisticTensorDictSequential:
    network = gaussian_network(5, 2, hidden=[8])
    return make_constrained_actor(network, env)


def assert_guards(env: EnvBase, actor: SafeProbabilisticTensorDictSequential) -> None:
    """Let the actor act over many episodes, and random actions not at all."""
    # Serial environments share tensors with their workers, which gradients do not allow.
    with torch.no_grad():
        rollout = env.rollout(50, actor, break_when_any_done=False)
    assert rollout["next", "done"].any()
    assert rollout["next", "cost"].sum() == 0
    with pytest.raises(ConstraintViolationError, match=r"constraint '(battery|obstacle)'"):
        env.rollout(200, break_when_any_done=False)


@pytest.mark.parametrize("batch_size", [(), (AGENTS,), (2, 3)], ids=str)
def test_random_actions_raise_and_constrained_ones_do_not(batch_size: tuple[int, ...]) -> None:
    env = guarded_env(*batch_size)
    assert_guards(env, untrained_actor(env))


@EVERY_COPY
@pytest.mark.parametrize("used", [False, True], ids=["new", "used"])
def test_copies(copied: Callable[[TransformedEnv], TransformedEnv], used: bool) -> None:
    env = guarded_env(AGENTS)
    actor = untrained_actor(env)
    if used:
        with torch.no_grad():
            env.rollout(3, actor)
    assert_guards(copied(env), actor)


@pytest.mark.parametrize("batch_size", [(), (3,)], ids=str)
def test_in_the_workers_of_a_batched_environment(batch_size: tuple[int, ...]) -> None:
    # Episodes of different lengths: one worker is reset while the others go on.
    workers = [partial(guarded_env, *batch_size, steps=steps) for steps in (7, 8, 11)]
    env = SerialEnv(3, workers)
    assert_guards(env, untrained_actor(guarded_env()))
    env.close()


def test_on_the_gymnasium_environment() -> None:
    env = constrained(base=GymEnv(POINT_NAV_ID)).append_transform(ActionGuard())
    env.auto_register_info_dict()
    env.set_seed(0)
    assert_guards(env, untrained_actor(env))


def test_agents_that_are_reset_alone() -> None:
    env = guarded_env(AGENTS, steps=1000)
    actor, state = untrained_actor(env), env.reset()
    for _ in range(60):
        _, state = env.step_and_maybe_reset(actor(state))
        state = env.reset(state.set("_reset", torch.rand(AGENTS, 1) < 0.1))


def test_steps_are_as_without_it() -> None:
    rollouts = []
    for env in (constrained(AGENTS), guarded_env(AGENTS)):
        torch.manual_seed(0)
        rollouts.append(env.rollout(40, untrained_actor(env), break_when_any_done=False))
    given, expected = rollouts
    assert set(given.keys(True, True)) == set(expected.keys(True, True))
    assert (given == expected).all()


def test_the_warm_up_of_a_collector_is_refused() -> None:
    env = guarded_env(AGENTS)
    collector = Collector(
        env,
        untrained_actor(env),
        frames_per_batch=20 * AGENTS,
        total_frames=20 * AGENTS,
        init_random_frames=20 * AGENTS,
        auto_register_policy_transforms=False,
    )
    with pytest.raises(ConstraintViolationError):
        list(collector)


def calm(env: EnvBase) -> TensorDictBase:
    """States in which no constraint binds for some steps."""
    return env.reset(position=(0.65, 0.65), battery=100)


def test_specs() -> None:
    env = guarded_env(3)
    check_env_specs(env, tensordict=calm(env))


@pytest.mark.parametrize("agent", [0, 2])
def test_only_what_is_stepped_is_checked(agent: int) -> None:
    env = guarded_env(3)
    state = calm(env)
    state["action"] = state["constraints", "anchor"].clone()
    state["action"][agent] = 5.0
    message = rf"constraint 'bounds'.*given \[5.0, 5.0\].*batch index \[{agent}\]"
    with pytest.raises(ConstraintViolationError, match=message):
        env.step(state.clone())
    for stepped in (torch.arange(3) != agent, (torch.arange(3) != agent).unsqueeze(-1)):
        env.step(state.clone().set("_step", stepped))
    with pytest.raises(ConstraintViolationError, match=message):
        env.step(state.clone().set("_step", torch.arange(3) == agent))


def test_what_it_needs_is_said() -> None:
    env = guarded_env(3)
    state = env.reset()
    no_geometry = TransformedEnv(PointNavEnv([3]), Compose(RewardSum(), ActionGuard()))
    with pytest.raises(ValueError, match="publishes at least one constraint"):
        no_geometry.rollout(1)
    no_anchor = TransformedEnv(PointNavEnv([3]), Compose(BatteryGeometry(), ActionGuard()))
    with pytest.raises(ValueError, match=r"publishes \('constraints', 'battery', 'active'\)"):
        no_anchor.rollout(1)
    with pytest.raises(KeyError, match=r"expected action, found keys .*call a policy"):
        env.transform.inv(state)
    with pytest.raises(RuntimeError, match="expected to be part of an environment"):
        ActionGuard().inv(state.set("action", torch.zeros(3, 2)))


def test_it_must_see_what_is_executed() -> None:
    """Inverse transforms run from the last to the first: one behind the guard acts before it."""
    scaling = ActionScaling(loc=torch.full((2,), 0.3), scale=torch.full((2,), 0.7))
    env = constrained(16).append_transform(scaling).append_transform(ActionGuard())
    with pytest.raises(ValueError, match=r"given one behind ActionScaling.*right after constrain"):
        env.rollout(1)
    env = constrained(16)
    actor = untrained_actor(env)
    env.append_transform(ActionGuard()).append_transform(scaling.clone())
    with pytest.raises(ConstraintViolationError):
        env.rollout(200, actor, break_when_any_done=False)


@pytest.mark.parametrize(
    ("geometry", "how"), [(Wall(), r"relaxed by 2 "), (Window("wall"), "dropped")]
)
def test_relaxation_can_be_refused(geometry: Wall, how: str) -> None:
    def environment(**options: bool) -> TransformedEnv:
        env = walls(Walls([HOLDS, HOLDS, MISSED], 3), copy.deepcopy(geometry))
        return env.append_transform(ActionGuard(**options))

    lenient, strict = environment(), environment(refuse_relaxation=True)
    state = strict.reset()
    state["action"] = state["constraints", "anchor"].clone()
    message = rf"constraint 'wall': expected to hold.*it is {how}.*batch index \[2\]"
    with pytest.raises(RelaxedConstraintError, match=message):
        strict.step(state.clone())
    strict.step(state.clone().set("_step", torch.tensor([True, True, False])))
    lenient.reset()
    lenient.step(state.clone())


def test_a_relaxed_constraint_is_told_from_a_broken_one() -> None:
    env = walls(Walls([HOLDS, MISSED], 2)).append_transform(ActionGuard())
    state = env.reset()
    actions = state["constraints", "anchor"].clone()
    env.step(state.clone().set("action", actions))
    for agent, message in enumerate(["inside its set, given", r"inside its set widened by 2,"]):
        broken = actions.clone()
        broken[agent, 0] = 0.9
        with pytest.raises(ConstraintViolationError, match=message) as caught:
            env.step(state.clone().set("action", broken))
        assert f"batch index [{agent}]" in str(caught.value)
        assert not isinstance(caught.value, RelaxedConstraintError)
