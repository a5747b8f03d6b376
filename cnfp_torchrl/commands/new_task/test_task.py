"""The limit holds in every step, and a step that breaks it would be seen."""

import torch
from tensordict import TensorDictBase
from torchrl.modules import MLP, NormalParamExtractor

from cnfp_torchrl import constrain_env, make_constrained_actor
from cnfp_torchrl.audit import AuditSettings, audit
from cnfp_torchrl.commands.new_task.environment import STEPS, PointMass
from cnfp_torchrl.commands.new_task.geometry import SpeedLimit


def test_a_policy_keeps_the_limit_before_it_learned_anything() -> None:
    """The judge counts no violation in whole episodes."""
    env = constrain_env(PointMass([64]), SpeedLimit("speed"))
    network = torch.nn.Sequential(MLP(4, 4, num_cells=[32]), NormalParamExtractor())
    steps = env.rollout(STEPS, make_constrained_actor(network, env), break_when_any_done=False)
    assert steps["next", "cost"].sum() == 0


def test_the_judge_sees_a_violation() -> None:
    """Without the constraint, full thrust breaks the limit."""
    env = PointMass([1])

    def push(tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", torch.ones(1, 2))

    assert env.rollout(STEPS, push, break_when_any_done=False)["next", "cost"].sum() > 0


def test_the_audit_finds_no_flaw() -> None:
    """Geometry, judge and environment agree, in states of episodes and in others."""
    env = constrain_env(PointMass([64]), SpeedLimit("speed"))
    report = audit(env, settings=AuditSettings(states=64, actions=32, steps=50))
    assert not report.flaws, str(report)
