"""A run as a function: observation in, allowed action out."""

import json
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import CatTensors, ObservationNorm, RenameTransform, TransformedEnv

from cnfp_torchrl import Ball, Box, GeometryTransform, constrain_env, make_constrained_actor
from cnfp_torchrl.configuration import compose_config, foreign_packages
from cnfp_torchrl.geometry import GeometryError
from cnfp_torchrl.modules import ConstraintViolationError
from cnfp_torchrl.tasks.point_nav import PointNavEnv
from cnfp_torchrl.training.agent import build_environment
from cnfp_torchrl.training.networks import gaussian_network
from cnfp_torchrl.training.policy import TrainedPolicy, load_policy
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.train import train
from tests.point_nav import make_rate_limited_env

from .conftest import TINY


@pytest.fixture(scope="module", params=["exact", "projection", "unconstrained"])
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    config = compose_config(*TINY, f"flow={request.param}", "evaluation.episodes=1")
    folder = RunFolder.create(tmp_path_factory.mktemp("run") / "run")
    train(config, folder)
    return folder


def steps(run: RunFolder) -> TensorDictBase:
    """Transitions of the deterministic policy in the environment of training."""
    env = build_environment(run.load_config(), batch_size=[8], with_anchor=True)
    env.set_seed(0)
    policy = load_policy(run.path)
    state, taken = env.reset(), []
    for _ in range(12):
        state["action"] = policy(state["observation"])
        transition, state = env.step_and_maybe_reset(state)
        taken.append(transition)
    return torch.stack(taken, 1)


def test_it_acts_as_the_actor_does_in_its_environment(run: RunFolder) -> None:
    policy = load_policy(run.path)
    rollout = steps(run)
    safe = policy.actor[-1].flow.is_safe
    if safe:
        assert rollout["next", "cost"].sum() == 0
    observations = rollout["observation"]
    actions = policy(observations)
    assert actions.shape == (8, 12, 2)
    one = policy(observations[3, 5])
    torch.testing.assert_close(one, actions[3, 5])
    array = policy(observations[3, 5].numpy().astype(np.float64))
    assert isinstance(array, np.ndarray)
    np.testing.assert_array_equal(array, one.numpy())
    drawn = load_policy(run.path, deterministic=False)
    assert not torch.equal(drawn(observations), drawn(observations))
    if safe:  # otherwise no policy was without violations
        assert load_policy(run.path, best=True)(observations).shape == actions.shape


def test_wrong_observations_are_refused_by_name(run: RunFolder) -> None:
    policy = load_policy(run.path)
    for wrong in (np.zeros(4), torch.zeros(3, 6), torch.zeros(())):
        with pytest.raises(ValueError, match=r"'observation': expected shape \(\*batch, 5\)"):
            policy(wrong)
    with pytest.raises(ValueError, match="'observation' is missing"):
        policy({"state": torch.zeros(5)})
    if policy.actor[-1].flow.is_safe:
        with pytest.raises((GeometryError, ConstraintViolationError), match="finite"):
            policy(torch.full((5,), torch.nan))


def test_a_missing_best_policy_is_named(run: RunFolder) -> None:
    best, kept = run.path / "best.pt", run.path / "kept"
    if best.exists():
        best.rename(kept)
    with pytest.raises(FileNotFoundError, match=r"^checkpoint: expected best\.pt"):
        load_policy(run.path, best=True)
    if kept.exists():
        kept.rename(best)


class AsBefore(GeometryTransform):
    """Reads an entry that networks do not."""

    def constraint_set(self, tensordict: TensorDictBase) -> Ball:
        center = 0.1 * tensordict["cost"]
        return Ball(center, torch.full_like(center[..., 0], 0.2), validate_args=False)


class Everywhere(GeometryTransform):
    def constraint_set(self, tensordict: TensorDictBase) -> Box:
        zero = 0 * tensordict["observation"][..., :2]
        return Box(zero - 1, zero + 1, validate_args=False)


class Nested(AsBefore):
    def constraint_set(self, tensordict: TensorDictBase) -> Ball:
        return super().constraint_set(tensordict["far"])


def test_what_only_constraints_read_is_asked_for() -> None:
    env = constrain_env(PointNavEnv([1]), AsBefore("ball", in_keys=["cost"]))
    actor = make_constrained_actor(gaussian_network(5, 2, hidden=[4]), env)
    policy = TrainedPolicy(actor, env)
    assert policy.in_keys == ["cost", "observation"]
    cost, observation = torch.ones(2), torch.zeros(5)
    action = policy({"observation": observation, "cost": cost})
    assert (action - 0.1 * cost).norm() <= 0.2
    with pytest.raises(ValueError, match="a mapping with the entries"):
        policy(observation)
    for wrong in ("nonsense", ["a", "b"], object()):
        with pytest.raises(TypeError, match="'cost': expected an array or a tensor of numbers"):
            policy({"observation": observation, "cost": wrong})


def test_nested_entries_are_taken_as_gymnasium_nests_them() -> None:
    nested = RenameTransform(["cost"], [("far", "cost")])
    env = constrain_env(TransformedEnv(PointNavEnv([1]), nested), Nested("ball", [["far", "cost"]]))
    actor = make_constrained_actor(gaussian_network(5, 2, hidden=[4]), env)
    policy = TrainedPolicy(actor, env)
    assert policy.in_keys == [("far", "cost"), "observation"]
    cost, observation = torch.ones(2), torch.zeros(5)
    action = policy({"observation": observation, "far": {"cost": cost}})
    same = policy({"observation": observation, ("far", "cost"): cost})
    assert torch.equal(action, same)
    with pytest.raises(ValueError, match=r"\('far', 'cost'\) is missing"):
        policy({"observation": observation, "far": cost})


def test_a_concatenated_vector_may_be_given_by_its_parts() -> None:
    """Of which geometry reads one, and the first has the vector's own name."""
    env = make_rate_limited_env((3,))
    actor = make_constrained_actor(gaussian_network(7, 2, hidden=[4]), env)
    policy = TrainedPolicy(actor, env)
    assert policy.in_keys == ["previous_action", "observation"]
    rollout: Any = env.rollout(4, actor).detach()
    state, previous = rollout["observation"].split([5, 2], -1)
    action = policy({"observation": state, "previous_action": previous})
    assert torch.equal(action, policy({name: rollout[name] for name in policy.in_keys}))
    assert ((action - previous).abs() <= 0.2).all()
    with pytest.raises(ValueError, match=r"'observation': expected shape \(\*batch, 5\)"):
        policy({"observation": state[..., 1:], "previous_action": previous})
    with pytest.raises(ValueError, match="'previous_action' is missing"):
        policy({"observation": state})


def test_what_a_robot_observes_is_concatenated_as_in_training() -> None:
    names = [("arm", "state"), "load"]
    base = TransformedEnv(PointNavEnv([1]), RenameTransform(["observation", "cost"], names))
    base.append_transform(CatTensors(names, "observation", sort=False))
    env = constrain_env(base, Everywhere("box"))
    policy = TrainedPolicy(make_constrained_actor(gaussian_network(7, 2, hidden=[4]), env), env)
    assert policy.in_keys == names
    state, load = np.ones(5), np.zeros(2)
    given: Any = {"arm": {"state": state}, "load": load}
    action = policy(given)
    assert isinstance(action, np.ndarray)
    np.testing.assert_array_equal(action, policy(np.concatenate([state, load])))


def test_a_vector_that_changes_behind_the_geometries_is_refused() -> None:
    env = constrain_env(PointNavEnv([1]), Everywhere("box"))
    env.append_transform(ObservationNorm(0.0, 2.0, in_keys=["observation"]))
    actor = make_constrained_actor(gaussian_network(5, 2, hidden=[4]), env)
    with pytest.raises(ValueError, match=r"no transform that changes.*ObservationNorm"):
        TrainedPolicy(actor, env)


@pytest.mark.parametrize("given", [None, 3])
def test_a_run_is_a_path(given: object) -> None:
    with pytest.raises(TypeError, match=f"run: expected the path of a run's folder, given {given}"):
        load_policy(given)  # type: ignore[arg-type]


def test_the_summary_says_where_the_run_came_from(run: RunFolder) -> None:
    summary: dict[str, Any] = json.loads((run.path / "summary.json").read_text())
    assert {"python", "torch", "torchrl", "tensordict"} <= set(summary["versions"])
    assert torch.__version__.startswith(summary["versions"]["torch"].partition("+")[0])
    assert summary["machine"]["device"] == "cpu"
    assert summary["machine"]["cores"] >= 1
    assert summary["command"]
    commit = summary["commit"]
    assert commit is None or len(commit.partition(",")[0]) == 40


def test_whoever_reads_a_run_is_told_whom_to_trust() -> None:
    assert foreign_packages(compose_config()) == []
    own = compose_config("env.base._target_=my_pendulum.make_env")
    assert foreign_packages(own) == ["my_pendulum."]
