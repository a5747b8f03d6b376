"""The TorchRL environment: specs, seeds, resets, bad input; the dynamics have their own file."""

import copy
import pickle

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import Compose, EnvBase, SerialEnv, TransformedEnv, check_env_specs
from torchrl.modules import RandomPolicy

from cnfp_torchrl.envs import ConstraintCost
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, Layout, ObstacleGeometry, PointNavEnv
from tests.layouts import NONE, THREE

LAYOUTS = {"reference": Layout(), "none": NONE, "three": THREE}


def with_transforms(env: PointNavEnv) -> TransformedEnv:
    layout = env.layout
    return TransformedEnv(
        env, Compose(ObstacleGeometry(layout), BatteryGeometry(layout), ConstraintCost())
    )


@pytest.mark.parametrize("transformed", [False, True])
@pytest.mark.parametrize("batch_size", [(), (1,), (5,), (2, 3)])
@pytest.mark.parametrize("name", LAYOUTS)
def test_specs(name: str, batch_size: tuple[int, ...], transformed: bool) -> None:
    env: EnvBase = PointNavEnv(batch_size, layout=LAYOUTS[name], device="cpu")
    check_env_specs(with_transforms(env) if transformed else env)


def test_specs_do_not_depend_on_the_default_dtype() -> None:
    torch.set_default_dtype(torch.float64)
    try:
        env = PointNavEnv((2,))
        check_env_specs(env)
        assert {x.dtype for x in (env.reset()["observation"], env.state.goal)} == {torch.float32}
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("batch_size", [(), (3,)])
def test_the_same_seed_gives_the_same_episode(batch_size: tuple[int, ...]) -> None:
    def episode(env: PointNavEnv, seed: int) -> torch.Tensor:
        torch.manual_seed(1)  # of the random actions
        env.set_seed(seed)
        return env.rollout(30)["next", "observation"]

    one, two = PointNavEnv(batch_size, seed=8), PointNavEnv(batch_size)
    assert torch.equal(episode(one, 5), episode(two, 5))
    assert not torch.equal(episode(one, 5), episode(two, 6))


def test_without_a_seed_the_global_generator_decides() -> None:
    torch.manual_seed(3)
    one = PointNavEnv((4,)).reset()["observation"]
    torch.manual_seed(3)
    assert torch.equal(PointNavEnv((4,)).reset()["observation"], one)
    assert not torch.equal(PointNavEnv((4,)).reset()["observation"], one)


def test_episodes_are_truncated_and_have_no_terminal_state() -> None:
    rollout = PointNavEnv((2,), seed=0).rollout(300)
    assert rollout.shape == (2, 100)
    done = torch.zeros(2, 100, 1, dtype=torch.bool)
    done[:, -1] = True
    assert torch.equal(rollout["next", "truncated"], done)
    assert torch.equal(rollout["next", "done"], done)
    assert not rollout["next", "terminated"].any()


@pytest.mark.parametrize("batch_size", [(3,), (2, 2)])
def test_a_reset_of_some_agents_leaves_the_others_alone(batch_size: tuple[int, ...]) -> None:
    env = with_transforms(PointNavEnv(batch_size, seed=0))
    state = env.reset()
    for _ in range(4):
        state = env.step(state.set("action", torch.ones(*batch_size, 2)))["next"]
    which = torch.zeros(*batch_size, 1, dtype=torch.bool)
    which.view(-1)[1] = True
    fresh = env.reset(state.clone().set("_reset", which))
    keep = ~which.squeeze(-1)
    for key in ("observation", "episode_cost", ("constraints", "battery", "radius")):
        assert torch.equal(fresh[key][keep], state[key][keep])
        assert not torch.equal(fresh["observation"][~keep], state["observation"][~keep])
    assert (fresh["cost"][~keep] == 0).all()
    assert (fresh["episode_cost"][~keep] == 0).all()
    assert env.steps.view(-1).tolist() == [0 if i == 1 else 4 for i in range(keep.numel())]


def test_auto_reset_in_collectors_and_batched_environments() -> None:
    """At the end of an episode, next shows its last state, and the following root a fresh one."""

    def make() -> TransformedEnv:
        return with_transforms(PointNavEnv(max_steps=7, seed=0))

    serial = SerialEnv(2, make)
    serial.set_seed(1)
    native = with_transforms(PointNavEnv((2,), max_steps=7, seed=0))
    policy = RandomPolicy(native.action_spec)
    collector = Collector(native, policy, frames_per_batch=40, total_frames=40)
    batches = [serial.rollout(20, break_when_any_done=False), *collector]
    collector.shutdown()
    for data in batches:
        assert data.shape == (2, 20)
        ends = data["next", "done"].squeeze(-1)
        assert ends[0].nonzero().flatten().tolist() == [6, 13]
        same = (data["next", "observation"][:, :-1] == data["observation"][:, 1:]).all(-1)
        assert torch.equal(same, ~ends[:, :-1])
        total = data["episode_cost"] + data["next", "cost"]
        assert torch.equal(data["next", "episode_cost"], total)
        assert (data["episode_cost"][:, [0, 7, 14]] == 0).all()
        geometry = data.select(("constraints", "obstacle"), ("next", "constraints", "obstacle"))
        again = ObstacleGeometry()(data.clone())
        assert (again.select(*geometry.keys(True, True)) == geometry).all()


def test_a_reset_to_a_chosen_state() -> None:
    env = with_transforms(PointNavEnv((2,), seed=0))
    state = env.reset(position=[0.5, 0.25], battery=[21, 90])
    assert torch.equal(state["observation"][:, :2], torch.tensor([[0.5, 0.25]]).expand(2, 2))
    assert state["constraints", "battery", "radius"].tolist() == pytest.approx([0.9, 63.0])


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ({"position": [1.5, 0.0]}, r"position: expected numbers in \[-1.0, 1.0\]"),
        ({"position": [float("nan"), 0.0]}, "position: expected numbers"),
        ({"position": [0.0, 0.0, 0.0]}, r"position: .*broadcasts to \(2, 2\), given \(3,\)"),
        ({"battery": 101}, r"battery: expected integers in \[0, 100\]"),
        ({"battery": 50.5}, "battery: expected integers"),
        ({"goal": [0.0, -1.01]}, "goal: expected numbers"),
    ],
)
def test_a_bad_state_is_refused(chosen: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PointNavEnv((2,)).reset(**chosen)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"collision": "bounce"}, r"collision: expected one of \['pass', 'block'\]"),
        ({"max_steps": 0}, "max_steps: expected a whole number >= 1"),
        ({"max_steps": 2.5}, "max_steps: expected"),
        ({"batch_size": (3, 0)}, r"batch_size: expected sizes >= 1, given \(3, 0\)"),
    ],
)
def test_bad_arguments_are_refused(bad: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PointNavEnv(**bad)  # type: ignore[arg-type]


@pytest.mark.parametrize("transformed", [False, True])
def test_bad_actions_are_refused(transformed: bool) -> None:
    env: EnvBase = PointNavEnv((2,))
    env = with_transforms(env) if transformed else env
    state = env.reset()
    action = torch.tensor([[0.0, 0.0], [0.0, float("nan")]])
    with pytest.raises(ValueError, match=r"action at index \[1, 1\]: expected a finite number"):
        env.step(state.clone().set("action", action))
    with pytest.raises(ValueError, match=r"action: expected shape \(2, 2\), given \(2, 3\)"):
        env.step(state.clone().set("action", torch.zeros(2, 3)))
    action = torch.tensor([[float("inf"), 0.0], [-float("inf"), 0.0]])
    assert env.step(state.set("action", action))["next", "observation"].isfinite().all()


def test_its_state_travels() -> None:
    """Copies, pickles and state dicts go on exactly where the original stood."""
    env = PointNavEnv((3,), seed=0)
    env.rollout(10)
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env)), PointNavEnv((3,))]
    copies[2].load_state_dict(env.state_dict())

    def future(env: PointNavEnv) -> torch.Tensor:
        torch.manual_seed(2)
        state = env.rand_step()["next"]
        return torch.cat([state["observation"], env.reset()["observation"]])

    expected = future(env)
    for twin in copies:
        assert twin.steps.tolist() == [10, 10, 10] or twin is env
        assert torch.equal(future(twin), expected)


def test_constraint_names_are_readable_through_transforms() -> None:
    assert with_transforms(PointNavEnv()).constraint_names == ("obstacle", "battery")
