"""A compiled step: the same sets, anchors and refusals as without, between resets."""

import pickle
from collections.abc import Callable
from copy import deepcopy
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl import Ball, GeometryTransform, HalfSpaces, constrain_env
from cnfp_torchrl.envs import constraint_bijectors
from cnfp_torchrl.geometry import Evidence, GeometryError
from cnfp_torchrl.modules import ConstrainedFlowModule, SafeRandomPolicy
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from tests.host_reads import HostReads


class Brake(GeometryTransform):
    """Half-spaces, which no candidate helps: one of them cannot hold in some states."""

    def constraint_set(self, tensordict: TensorDictBase) -> HalfSpaces:
        x, y = tensordict["observation"][..., :2].unbind(-1)
        normals = torch.eye(2).expand(*x.shape, 2, 2)
        return HalfSpaces(normals, torch.stack([x - 0.7, 1 - y], -1), validate_args=False)


class Near(GeometryTransform):
    """A ball around a set that was published before."""

    def constraint_set(self, tensordict: TensorDictBase) -> Ball:
        corner = tensordict["constraints", "brake", "offsets"]
        return Ball(corner - 0.5, torch.full_like(corner[..., 0], 1.2), validate_args=False)


def point_nav(compile: bool) -> TransformedEnv:
    env = PointNavEnv([5], seed=0, max_steps=4)
    return constrain_env(env, BatteryGeometry(), ObstacleGeometry(), compile=compile)


def user(compile: bool) -> TransformedEnv:
    near = Near("near", [("constraints", "brake", "offsets")])
    env = PointNavEnv([5], seed=0, max_steps=4)
    return constrain_env(env, Brake("brake"), near, compile=compile)


def nested(compile: bool) -> TransformedEnv:
    env = constrain_env(PointNavEnv([5], seed=0, max_steps=4), BatteryGeometry())
    return constrain_env(env, ObstacleGeometry(), compile=compile)


@pytest.fixture
def interpreted(monkeypatch: pytest.MonkeyPatch) -> list[Callable[..., Any]]:
    """Take functions for their compiled ones, and list those that were compiled."""
    compiled: list[Callable[..., Any]] = []

    def instead(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
        compiled.append(function)
        return function

    monkeypatch.setattr(torch, "compile", instead)
    return compiled


def rollout(env: TransformedEnv) -> TensorDictBase:
    torch.manual_seed(0)
    head = ConstrainedFlowModule(env.action_spec_unbatched, constraint_bijectors(env))
    policy = SafeRandomPolicy(SafeProbabilisticTensorDictSequential(head))
    return env.rollout(9, policy, break_when_any_done=False)


@pytest.mark.parametrize("make", [point_nav, user, nested])
def test_all_that_is_published_is_the_same(
    make: Callable[[bool], TransformedEnv], interpreted: list[Callable[..., Any]]
) -> None:
    plain, compiled = (rollout(make(compile)) for compile in (False, True))
    assert (plain == compiled).all()
    # Once, though episodes of 4 steps are reset.
    assert [f.__name__ for f in interpreted] == ["_all_published", "_all_stepped"]
    if make is user:
        active = plain["constraints", "brake", "active"]
        assert active.any()
        assert not active.all()


@pytest.mark.parametrize(
    "after", [lambda env: env, deepcopy, lambda env: pickle.loads(pickle.dumps(env))]
)
def test_what_is_wrong_at_a_step_is_refused(
    after: Callable[[EnvBase], EnvBase], interpreted: list[Callable[..., Any]]
) -> None:
    """Also by a copy, which leaves the compiled function behind until it is reset."""
    env = point_nav(True)
    state = env.rand_action(env.reset())
    env = after(env)
    assert ("constraints", "battery", "center") in env.step(state.clone())["next"].keys(True)
    env.base_env.position[3, 1] = torch.nan
    with pytest.raises(GeometryError, match=r"'battery', key 'observation' at index \[3, 1\]"):
        env.step(state)


def test_geometry_that_is_alone_publishes_itself(interpreted: list[Callable[..., Any]]) -> None:
    """In a replay buffer, and in another environment."""
    env = point_nav(True)
    stored = rollout(env).reshape(-1)
    fresh = stored.exclude("constraints", ("next", "constraints"))
    for transform in env.transform:
        fresh = transform.clone()(fresh)
    assert (fresh["next", "constraints"] == stored["next", "constraints"]).all()
    battery = env.transform[0].clone()
    other = TransformedEnv(PointNavEnv([2], seed=0), battery)
    assert ("constraints", "battery", "center") in other.rollout(2)["next"].keys(True)


@pytest.mark.parametrize("together", [True, False])
def test_stored_states_are_filled_in_within_an_episode(together: bool) -> None:
    """By an environment's own transforms: its steps go on in one pass, with the same results."""
    env, other = point_nav(False), point_nav(False)
    state = env.rand_action(env.reset())
    other.reset()
    stored = state.select("observation")
    transforms = [env.transform] if together else list(env.transform)
    for transform in transforms:
        stored = transform(stored)
    assert (stored["constraints"] == state["constraints"]).all()
    assert all(geometry.is_published_by_another for geometry in list(env.transform)[:2])
    assert (env.step(state.clone()) == other.step(state.clone())).all()


def test_a_reset_reads_all_checks_at_once() -> None:
    env = point_nav(False)
    state = env.reset()
    with HostReads() as reads:
        again = env.reset(position=state["observation"][:, :2], battery=60)
    assert [line.rpartition(" ")[2] for line in reads.lines if "cnfp_torchrl/envs/" in line] == [
        "tolist"
    ]
    assert again["constraints", "anchor"].shape == (5, 2)
    # What is appended or taken away between two resets counts.
    env.insert_transform(2, Brake("brake"))
    assert ("constraints", "brake", "offsets") in env.reset().keys(True)
    alone = TransformedEnv(env.base_env, deepcopy(env.transform[0]))
    assert ("constraints", "battery", "radius") in alone.reset().keys(True)


def test_a_geometry_whose_anchor_was_taken_away_publishes_itself() -> None:
    env = point_nav(False)
    env.reset()
    env.transform.pop(2)
    assert ("constraints", "obstacle", "low") in env.rollout(3)["next"].keys(True)


class Contradicting(Ball):
    """A family that tells of values beyond a limit, and finds none when it is asked which."""

    def evidence(self) -> list[Evidence]:
        return [*super().evidence(), Evidence(self.center[..., 0].amax(), 0.0)]


class Contradiction(GeometryTransform):
    def constraint_set(self, tensordict: TensorDictBase) -> Ball:
        x = tensordict["observation"][..., :2]
        return Contradicting(x, torch.full_like(x[..., 0], 2.0), validate_args=False)


@pytest.mark.parametrize("with_anchor", [True, False])
def test_values_beyond_limits_end_the_episode_though_none_is_found(with_anchor: bool) -> None:
    env = constrain_env(PointNavEnv([1]), Contradiction("odd"), with_anchor=with_anchor)
    state = env.reset(position=(0.0, 0.0)).set("action", torch.tensor([[1.0, 0.0]]))
    with pytest.raises(GeometryError, match=r"\['odd'\]: expected values within the limits"):
        env.step(state)


ROOM = [1.0]
"""What `Adjustable` reads; a constraint's own module, unlike libraries, may change."""


class Adjustable(GeometryTransform):
    radius = 1.0

    def constraint_set(self, tensordict: TensorDictBase) -> Ball:
        x = tensordict["observation"][..., :2]
        return Ball(x, torch.full_like(x[..., 0], self.radius + ROOM[0]), validate_args=False)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
def test_what_a_constraint_reads_may_change(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.compiler.reset()
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="eager"))
    geometry = Adjustable("near")
    env = constrain_env(PointNavEnv([5], seed=0), geometry, compile=True)
    state, radii = env.reset(), []
    for radius, room in ((1.0, 1.0), (2.0, 1.0), (2.0, 2.0)):
        geometry.radius, ROOM[0] = radius, room
        state = env.step_mdp(env.step(state.set("action", torch.zeros(5, 2))))
        radii.append(float(state["constraints", "near", "radius"].max()))
    assert radii == [2.0, 3.0, 4.0]


def test_without_an_anchor_nothing_would_call_it() -> None:
    with pytest.raises(ValueError, match="compile: expected False with with_anchor=False"):
        constrain_env(PointNavEnv([2]), BatteryGeometry(), with_anchor=False, compile=True)


@pytest.mark.slow
# Inductor trips over deprecations of PyTorch itself.
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
@pytest.mark.parametrize("make", [point_nav, user])
def test_compiled_by_the_compiler(make: Callable[[bool], TransformedEnv]) -> None:
    """In one graph; the sets differ by rounding alone, and no action leaves them."""
    torch.compiler.reset()
    plain = rollout(make(False))
    with torch._dynamo.config.patch(error_on_recompile=True):
        compiled = rollout(make(True))
    assert torch._dynamo.utils.counters["graph_break"] == {}
    keys = [key for key in plain.keys(True, True) if plain[key].is_floating_point()]
    for key in keys:
        torch.testing.assert_close(compiled[key], plain[key], rtol=1e-3, atol=1e-4)
    if make is point_nav:
        assert not compiled["next", "cost"].any()
