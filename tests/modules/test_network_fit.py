"""Networks that do not fit their environment are refused before the first step, by name."""

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal

from cnfp_torchrl import WeightedL1Ball, constrain, constrain_env, make_constrained_actor
from cnfp_torchrl.envs import GeometryTransform, constraint_bijectors
from cnfp_torchrl.modules import flow_head


class Gentle(GeometryTransform):
    def constraint_set(self, tensordict: TensorDictBase) -> WeightedL1Ball:
        return WeightedL1Ball(tensordict["observation"][..., 2:], torch.tensor(4.0))


@pytest.fixture
def env() -> TransformedEnv:
    return constrain_env(GymEnv("Pendulum-v1"), Gentle("gentle"))


def gaussian(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(MLP(inputs, outputs, num_cells=[4]), NormalParamExtractor())


WRONG: dict[str, tuple[Callable[[], nn.Module], str]] = {
    "inputs": (lambda: gaussian(4, 2), r"'observation' \(float32, shape \(3,\)\)"),
    "outputs": (lambda: gaussian(3, 4), r"'loc' and 'scale' of 1 components.*shape \(2,\)"),
    "odd outputs": (lambda: gaussian(3, 3), "components"),
    "no scale": (lambda: MLP(3, 1, num_cells=[4]), "fails"),
    "dtype": (lambda: gaussian(3, 2).double(), "DoubleToFloat"),
}


@pytest.mark.parametrize(("make", "message"), WRONG.values(), ids=WRONG)
def test_wrong_networks_are_refused_by_name(
    make: Callable[[], nn.Module], message: str, env: TransformedEnv
) -> None:
    with pytest.raises(ValueError, match=rf"(?s)^network: expected.*{message}"):
        make_constrained_actor(make(), env)
    body = TensorDictModule(make(), ["observation"], ["loc", "scale"])
    actor = ProbabilisticActor(
        body,
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -2.0, "high": 2.0},
    )
    with pytest.raises(ValueError, match=rf"(?s)^actor: expected.*{message}"):
        constrain(actor, env)


def test_without_an_environment_the_first_use_names_the_keys(env: TransformedEnv) -> None:
    actor = make_constrained_actor(
        gaussian(3, 4), bijectors=constraint_bijectors(env), spec=env.action_spec_unbatched
    )
    with pytest.raises(ValueError, match=r"keys \['loc', 'scale'\]: expected .* 1 components"):
        actor(env.reset())


def test_trying_changes_nothing_and_open_sizes_pass(env: TransformedEnv) -> None:
    norm = nn.BatchNorm1d(3)
    seed = torch.random.get_rng_state()
    network = nn.Sequential(norm, nn.Dropout(), *gaussian(3, 2))
    torch.random.set_rng_state(seed)
    make_constrained_actor(network, constrain_env(GymEnv("Pendulum-v1"), Gentle("gentle")))
    assert norm.num_batches_tracked == 0
    assert network.training
    assert torch.equal(torch.random.get_rng_state(), seed)
    lazy = nn.Sequential(MLP(out_features=2, num_cells=[4]), NormalParamExtractor())
    actor = make_constrained_actor(lazy, env)
    assert env.rollout(3, actor)["action"].shape == (3, 1)
    assert flow_head(actor).action_dim == 1
