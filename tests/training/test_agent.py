"""Environments of a configuration whose environments are processes."""

from functools import partial

import pytest
from omegaconf import DictConfig, OmegaConf
from torchrl.envs import EnvBase, GymEnv, ParallelEnv, StepCounter, TransformedEnv

from cnfp_torchrl.training.agent import build_environment


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
