"""Robots: judges against published states, geometry against judges, hostile latents."""

import math

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.audit import AuditSettings, audit
from cnfp_torchrl.configuration import compose_config, config_directory
from cnfp_torchrl.modules import flow_head
from cnfp_torchrl.tasks.robots import PowerLimit, RateLimit, RobotEnv, robot_with_previous_action
from cnfp_torchrl.training.agent import build_actor, build_environment
from cnfp_torchrl.training.policy import TrainedPolicy

TASKS = sorted(
    path.stem
    for path in config_directory().glob("env/*.yaml")
    if path.stem not in ("point_nav", "safe_control")
)


def environment(
    task: str, agents: int
) -> tuple[TransformedEnv, SafeProbabilisticTensorDictSequential]:
    config = compose_config(f"env={task}")
    env = build_environment(config, batch_size=[agents], with_anchor=True)
    env.set_seed(0)
    return env, build_actor(config, env)


def published_violations(task: str, steps: TensorDictBase) -> Tensor:
    """The definitions as published, anew, of recorded steps; in the order of the costs."""
    action = steps["action"].double()
    d = action.shape[-1]
    velocity, angle = steps["qvel"][..., -d:], steps["qpos"][..., -d:]
    if task.endswith("rate"):
        limits = {
            "half_cheetah_rate": [0.2] * 3 + [0.5] * 3,
            "hopper_rate": [0.2, 0.5, 0.5],
            "ant_rate": [0.2] * 4 + [0.5] * 4,
        }[task]
        change = (action - steps["previous_action"].double()).abs()
        return (change > torch.tensor(limits, dtype=torch.float64)).any(-1, keepdim=True)
    power = velocity * action
    if task.endswith("drawn_power"):
        return power.clamp(min=0).sum(-1, keepdim=True) > 10
    if task == "half_cheetah_power":
        return power.abs().sum(-1, keepdim=True) > 20
    effort = (action * angle.sin()).square().sum(-1)
    return torch.stack([power.abs().sum(-1) > 10, effort > 0.1], -1)


@pytest.mark.parametrize("task", TASKS)
def test_hostile_latents_never_violate_and_the_judges_say_what_was_published(task: str) -> None:
    torch.manual_seed(0)
    env, actor = environment(task, 4)
    head = flow_head(actor)

    def hostile(state: TensorDictBase) -> TensorDictBase:
        latent = torch.randn(4, head.bounds.dim) * 10 ** (torch.rand(4, 1) * 8 - 2)
        return state.set("action", head.get_bijector(state)(latent))

    kept = env.rollout(50, hostile, break_when_any_done=False)
    assert (kept["next", "cost"] == 0).all()
    assert not published_violations(task, kept).any()

    def accelerate(state: TensorDictBase) -> TensorDictBase:
        signs = state["qvel"][..., -head.action_dim :].sign().float()
        return state.set("action", torch.where(torch.rand_like(signs) < 0.8, signs, -signs))

    free = env.rollout(50, accelerate, break_when_any_done=False)
    judged = free["next", "cost"] > 0
    assert (judged == published_violations(task, free)).all()
    assert judged.flatten(0, 1).any(0).all()


@pytest.mark.parametrize("task", ["half_cheetah_rate", "hopper_mixed", "walker2d_drawn_power"])
def test_the_audit_finds_no_flaw_and_full_coverage(task: str) -> None:
    env, _ = environment(task, 16)
    report = audit(env, settings=AuditSettings(states=32, actions=8, steps=20))
    assert report.flaws == []
    assert list(report.sources) == ["rollouts", "uniform"]
    for source in report.as_dict()["sources"].values():
        for kind in ("unsound", "escaped", "dead_ends"):
            assert source["together"][kind]["count"] == 0


def test_a_policy_takes_what_gymnasium_shows_and_the_previous_action() -> None:
    env, actor = environment("hopper_rate", 1)
    policy = TrainedPolicy(actor, env)
    assert set(policy.in_keys) == {"observation", "previous_action"}
    shown, _ = gymnasium.make("Hopper-v5").reset(seed=0)
    before = np.full(3, 0.9, dtype=np.float32)
    action = policy({"observation": shown, "previous_action": before})
    assert (np.abs(action - before) <= [0.2, 0.5, 0.5]).all()
    whole = np.concatenate([shown, before])
    same = policy({"observation": whole, "previous_action": before})
    np.testing.assert_array_equal(action, same)


def test_robots_start_and_end_apart() -> None:
    check_env_specs(RobotEnv("Hopper-v5", [3], max_steps=30, seed=5))
    env = RobotEnv("Hopper-v5", [3], max_steps=30, seed=5)
    again = RobotEnv("Hopper-v5", [3], max_steps=30, seed=5)
    first, second = env.reset(), again.reset()
    torch.testing.assert_close(first["qpos"], second["qpos"], rtol=0, atol=0)
    assert (first["qpos"][0] != first["qpos"][1]).any()
    steps = env.rollout(60, break_when_any_done=False)
    ends = steps["next", "done"].squeeze(-1)
    assert ends.sum(-1).min() >= 2
    # Each goes on from where it is, or starts anew.
    goes_on = ~ends[:, :-1]
    same = (steps["next", "qvel"][:, :-1] == steps["qvel"][:, 1:]).all(-1)
    assert (same == goes_on).all()


def test_chosen_states_are_shown_and_judged() -> None:
    """A robot put into a state with velocity 5 in each joint breaks the limit from .67 on."""
    env = environment("half_cheetah_power", 2)[0]
    state = env.reset()
    states = TensorDict(
        {"qpos": torch.zeros(2, 9).double(), "qvel": torch.full((2, 9), 5.0).double()}, [2]
    )
    robots = env.base_env
    assert isinstance(robots, RobotEnv)
    shown = robots.set_states(states)
    assert (shown["qvel"] == 5).all()
    assert (shown["observation"][:, 8:] == 5).all()
    action = torch.full((2, 6), math.nextafter(2 / 3, 1))
    action[1] = 0.6666
    after = robots.step(state.select("observation").update({"action": action}))
    assert after["next", "cost"].squeeze(-1).tolist() == [1, 0]


def test_a_clipped_observation_does_not_loosen_the_limit() -> None:
    """Hopper shows no velocity beyond 10; the limit is that of the simulator's."""
    env = environment("hopper_drawn_power", 1)[0]
    states = TensorDict(
        {"qpos": torch.zeros(1, 6).double(), "qvel": torch.full((1, 6), 40.0).double()}, [1]
    )
    shown = env.transform._reset(states.empty(), env.base_env.set_states(states))
    assert shown["observation"].max() == 10
    assert (shown["constraints", "power", "weights"] == 40).all()


def test_bad_arguments_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"power\.limit: expected a number > 0, given -1"):
        PowerLimit("power", -1.0, 6)
    with pytest.raises(ValueError, match=r"power\.joints: expected a number >= 1, given 0"):
        PowerLimit("power", 1.0, 0)
    with pytest.raises(ValueError, match=r"rate\.limits: expected numbers > 0"):
        RateLimit("rate", [0.1, 0.0])
    with pytest.raises(TypeError, match="expected an environment of MuJoCo, given 'Pendulum-v1'"):
        RobotEnv("Pendulum-v1")
    env = robot_with_previous_action("Hopper-v5", [1])
    env.reset()
    with pytest.raises(ValueError, match=r"action at index \[0, 0\]: expected a finite"):
        env.step(TensorDict({"action": torch.full((1, 3), torch.nan)}, [1]))


def test_there_is_one_configuration_for_each_published_task() -> None:
    assert len(TASKS) == 7
