"""The graph that is exported, in eager mode."""

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.data import Bounded
from torchrl.envs import ObservationNorm, TransformedEnv

from cnfp_torchrl import constrain_env
from cnfp_torchrl.deploy import DeployedPolicy, observed_states, self_test
from cnfp_torchrl.envs import GeometryTransform, constraint_bijectors
from cnfp_torchrl.geometry import HalfSpaces, attempt_anchor
from cnfp_torchrl.modules import make_constrained_actor
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.training.networks import gaussian_network
from experiments.exported import DIMENSIONS, policy_of
from tests.deploy.conftest import actor_for, point_nav
from tests.point_nav import make_rate_limited_env


def test_it_acts_as_the_actor_does(env: TransformedEnv) -> None:
    actor = actor_for(env)
    policy = DeployedPolicy(actor, env, steps=0)
    states = env.rollout(30, actor, break_when_any_done=False).reshape(-1)
    action, certified = policy(states["observation"])
    assert certified.float().mean() > 0.9
    # Where the first attempt was enough for the environment, too: elsewhere it has searched on.
    shown = policy.states(states["observation"])
    sets = [policy.bounds.on(None), *policy.sets(shown)]
    anchor, _ = attempt_anchor(sets, steps=0)
    same = certified & (anchor == states["constraints", "anchor"]).all(-1)
    assert same.float().mean() > 0.9
    expected = actor.get_dist(states).deterministic_sample
    torch.testing.assert_close(action[same], expected[same], rtol=1e-5, atol=1e-6)
    noise = torch.randn_like(action)
    sampled, _ = DeployedPolicy(actor, env, steps=0, stochastic=True)(states["observation"], noise)
    latent = states["loc"] + states["scale"] * noise
    pushed = actor.get_dist(states).bijector(latent)
    torch.testing.assert_close(sampled[same], pushed[same], rtol=1e-5, atol=1e-6)


def test_self_test_counts(env: TransformedEnv) -> None:
    actor = actor_for(env)
    policy = DeployedPolicy(actor, env, stochastic=True)
    states = observed_states(policy, env, actor, 1000)
    assert len(states[0]) == 1000
    found = self_test(policy, policy, states)
    assert found["states"] == 1000
    assert found["certified"] > 950
    assert found["violations"] == found["certified_otherwise_in_eager"] == 0

    def broken(*inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return 5 + policy(*inputs)[0], torch.arange(len(inputs[0])) % 2 == 0

    found = self_test(policy, broken, states)
    assert found["violations"] == found["certified"] == 500
    assert found["fallback_out_of_bounds"] == 500
    assert found["largest_difference"] > 4


def test_parts_of_a_vector_are_inputs_in_its_place() -> None:
    env = make_rate_limited_env((4,))
    actor = actor_for(env, size=7)
    policy = DeployedPolicy(actor, env)
    assert policy.input_keys == ["previous_action", "observation"]
    assert [tuple(example.shape) for example in policy.examples(3)] == [(3, 2), (3, 5)]
    found = self_test(policy, policy, observed_states(policy, env, actor, 200))
    assert found["certified"] == 200
    assert found["violations"] == 0
    states = env.rollout(3, actor).reshape(-1)
    inputs = states["previous_action"], states["observation"][:, :5]
    torch.testing.assert_close(policy.states(*inputs)["observation"], states["observation"])
    expected = actor.get_dist(states).deterministic_sample
    torch.testing.assert_close(policy(*inputs)[0], expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", DIMENSIONS)
def test_certified_actions_of_every_family_are_inside(name: str) -> None:
    policy, inputs = policy_of(name, 500)
    found = self_test(policy, policy, inputs)
    assert found["violations"] == found["fallback_out_of_bounds"] == 0
    assert found["certified"] > 0.25 * found["states"]


def test_what_cannot_hold_is_not_certified(env: TransformedEnv) -> None:
    actor = actor_for(env)
    inside = torch.tensor([[0.0, 0.0, 1.0, 0.5, 0.5]])  # in the rectangle
    empty = torch.tensor([[0.5, 0.5, 0.0, 0.5, 0.5]])  # without charge
    nan = torch.tensor([[0.5, torch.nan, 1.0, 0.5, 0.5]])
    states = torch.cat([inside, empty, nan])
    action, certified = DeployedPolicy(actor, env)(states)
    assert not certified.any()
    assert (action.abs() <= 1).all()
    action, certified = DeployedPolicy(actor, env, fallback=[0.25, -0.5])(states)
    assert not certified.any()
    assert action.tolist() == [[0.25, -0.5]] * 3


def test_refusals(env: TransformedEnv) -> None:
    with pytest.raises(ValueError, match=r"flow that guarantees.*SquashFlow"):
        DeployedPolicy(actor_for(env, flow="squash"), env)
    actor = actor_for(env)
    for fallback in ([0.0], [0.0, 2.0], [0.0, float("nan")]):
        with pytest.raises(ValueError, match=r"fallback: expected an action of 2 components"):
            DeployedPolicy(actor, env, fallback=fallback)
    with pytest.raises(ValueError, match="steps: expected a number >= 0"):
        DeployedPolicy(actor, env, steps=-1)
    one = constrain_env(PointNavEnv([4]), BatteryGeometry())
    with pytest.raises(ValueError, match=r"expected the environment's constraints \['battery'\]"):
        DeployedPolicy(actor, one)
    normed = point_nav().append_transform(ObservationNorm(0.0, 2.0, in_keys=["observation"]))
    with pytest.raises(ValueError, match=r"no transform that changes \['observation'\] behind"):
        DeployedPolicy(actor_for(normed), normed)
    wide = make_constrained_actor(
        gaussian_network(5, 2, hidden=[8]),
        bijectors=constraint_bijectors(env),
        spec=Bounded(-1.0, 1.5, (2,)),
    )
    with pytest.raises(ValueError, match="expected the environment's action bounds"):
        DeployedPolicy(wide, env)


def test_transforms_before_the_geometries_are_part_of_the_environment() -> None:
    base = TransformedEnv(PointNavEnv([4]), ObservationNorm(0.0, 1.0, in_keys=["observation"]))
    env = constrain_env(base, BatteryGeometry(), ObstacleGeometry())
    assert DeployedPolicy(actor_for(env), env).input_keys == ["observation"]


@pytest.mark.parametrize(("width", "least", "most"), [(1.0, 0.0, 1e-5), (1e-3, 2e-5, 1e-2)])
def test_the_self_test_tells_what_rounding_does_in_a_narrow_set(
    width: float, least: float, most: float
) -> None:
    class Band(GeometryTransform):
        def constraint_set(self, tensordict: TensorDictBase) -> HalfSpaces:
            middle = tensordict["observation"][..., :1] / 2
            normals = torch.tensor([[1.0, 1.0], [-1.0, -1.0]]).expand(*middle.shape[:-1], 2, 2)
            return HalfSpaces(normals, torch.cat([middle, -middle], -1) + width)

    env = constrain_env(PointNavEnv([8]), Band("band"))
    actor = actor_for(env)
    policy = DeployedPolicy(actor, env, stochastic=True)
    states = observed_states(policy, env, actor, 500)
    found = self_test(policy, policy, states)
    assert found["certified"] == 500
    assert found["largest_difference"] == 0
    assert least < found["largest_change_in_the_last_bit"] < most
