"""Environments of a configuration: those that are processes, and compiled ones."""

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from omegaconf import DictConfig, OmegaConf
from torchrl.envs import EnvBase, GymEnv, ParallelEnv, StepCounter, TransformedEnv

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.training.agent import (
    build_actor,
    build_critic,
    build_environment,
    training_environment,
)
from cnfp_torchrl.training.observation_scale import warn_of_large_observations


def parallel(batch_size: list[int]) -> EnvBase:
    env = ParallelEnv(batch_size[0], partial(GymEnv, "Pendulum-v1"))
    return TransformedEnv(env, StepCounter())


def config(flow: str) -> DictConfig:
    base = {"_target_": "tests.training.test_agent.parallel", "batch_size": [2]}
    flow_section = {"_target_": f"cnfp_torchrl.modules.{flow}"}
    return OmegaConf.create({"env": {"base": base}, "flow": flow_section})


def test_processes_are_no_more_than_in_training() -> None:
    env = build_environment(config("UnconstrainedFlow"), batch_size=[5])
    assert env.batch_size == (2,)


def test_a_refusal_is_not_hidden_by_processes_that_never_began() -> None:
    with pytest.raises(ValueError, match=r"env\.geometry: expected at least one constraint"):
        build_environment(config("ExactFlow"))


@pytest.mark.parametrize(
    ("overrides", "functions"),
    [
        (["compile=true"], ["StepGeometry._all_published", "StepGeometry._all_stepped"]),
        (["compile=false"], []),
        # Without an anchor, and without constraints, nothing calls it.
        (["compile=true", "flow=squash"], []),
        (["compile=true", "flow=unconstrained", "~env.geometry"], []),
    ],
)
def test_a_compiled_run_compiles_what_a_step_computes(
    overrides: list[str], functions: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled = []

    def instead(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
        compiled.append(function.__qualname__)
        return function

    monkeypatch.setattr(torch, "compile", instead)
    env = training_environment(compose_config("env.agents=2", *overrides))
    assert env.rollout(3)["next", "reward"].isfinite().all()
    assert compiled == functions


SCALE = [150.0, 90.0, 1.0, 0.01, 3.0]


def test_networks_read_scaled_observations_and_geometries_do_not() -> None:
    given = compose_config("env.agents=2", f"network.observation_scale={SCALE}")
    env = training_environment(given)
    state = env.rollout(2)
    networks = {"actor": build_actor(given, env)[0], "critic": build_critic(given, env)}
    given.network.observation_scale = None
    plain = {"actor": build_actor(given, env)[0], "critic": build_critic(given, env)}
    for name, network in networks.items():
        weights = {key.replace("network.", "", 1): x for key, x in network.state_dict().items()}
        plain[name].load_state_dict({k: x for k, x in weights.items() if not k.endswith("scale")})
        scaled = state.clone()
        scaled["observation"] = scaled["observation"] / torch.tensor(SCALE)
        written, expected = network(state.clone()), plain[name](scaled)
        for key in network.out_keys:
            torch.testing.assert_close(written[key], expected[key])


@pytest.mark.parametrize("scale", [[1.0], [1, 1, 1, 1, 0], [1, 1, 1, 1, -1.0], [1, 1, 1, 1, "x"]])
def test_a_scale_that_does_not_fit_is_refused(scale: list[object]) -> None:
    given = compose_config("env.agents=2")
    given.network.observation_scale = scale
    with pytest.raises(ValueError, match=r"^network\.observation_scale: .*the 5 components"):
        build_actor(given, training_environment(given))


def test_large_observations_are_warned_of_unless_they_are_scaled() -> None:
    given = compose_config("env.agents=2")
    env = training_environment(given)
    warn_of_large_observations(given, env)  # those of point navigation are not large
    env = TransformedEnv(GymEnv("MountainCarContinuous-v0"))
    warn_of_large_observations(given, env)
    warn_of_large_observations(given, TransformedEnv(GymEnv("CartPole-v1")))  # without ends
    env = TransformedEnv(GymEnv("Acrobot-v1"))
    with pytest.warns(
        UserWarning, match=r"reach 28.3.*network\.observation_scale=\[1,1,1,1,12.6,28.3\]"
    ):
        warn_of_large_observations(given, env)
    given.network.observation_scale = [1, 1, 1, 1, 13, 28]
    warn_of_large_observations(given, env)
