"""Environments of a configuration: those that are processes, and compiled ones."""

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from omegaconf import DictConfig, OmegaConf
from torchrl.envs import EnvBase, GymEnv, ParallelEnv, StepCounter, TransformedEnv

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.training.agent import build_environment, training_environment


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
        (["compile=true"], ["StepGeometry._all_published"]),
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
