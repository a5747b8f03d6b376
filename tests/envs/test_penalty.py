"""The penalty: what the agent is paid, and what it is judged by."""

from pathlib import Path

import pytest
import torch
from omegaconf import DictConfig
from torchrl.envs import Compose, GymEnv, RewardSum, TransformedEnv, check_env_specs

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.envs import RewardPenalty
from cnfp_torchrl.tasks.point_nav import PointNavEnv
from cnfp_torchrl.training.agent import build_environment
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.train import train


@pytest.mark.parametrize("batch_size", [(), (8,), (2, 4)])
@pytest.mark.parametrize("penalty", [100.0, 7])
def test_a_violation_costs_the_penalty(batch_size: tuple[int, ...], penalty: float) -> None:
    steps, time = 45, len(batch_size)
    env, plain = PointNavEnv(batch_size, max_steps=15), PointNavEnv(batch_size, max_steps=15)
    paid = TransformedEnv(env, Compose(RewardSum(), RewardPenalty(penalty)))
    check_env_specs(paid)
    data = []
    for built in (paid, plain):
        built.set_seed(5)
        torch.manual_seed(5)
        data.append(built.rollout(steps, break_when_any_done=False))
    punished, raw = data
    reward = raw["next", "reward"]
    assert torch.equal(punished["next", "raw_reward"], reward)
    violated = raw["next", "cost"].any(-1, keepdim=True)
    if batch_size:
        assert 0 < violated.float().mean() < 1
    assert (punished["next", "reward"][violated] == -penalty).all()
    assert torch.equal(punished["next", "reward"][~violated], reward[~violated])
    for episode, true in zip(punished.split(15, time), reward.split(15, time), strict=True):
        torch.testing.assert_close(episode["next", "episode_reward"], true.cumsum(time))


def test_a_reset_starts_from_zero() -> None:
    env = TransformedEnv(PointNavEnv((3,)), RewardPenalty())
    state = env.step(env.rand_action(env.reset()))["next"]
    assert (state["raw_reward"] != 0).all()
    state["_reset"] = torch.tensor([[True], [False], [False]])
    after = env.reset(state.clone())
    assert after["raw_reward"][0] == 0
    assert torch.equal(after["raw_reward"][1:], state["raw_reward"][1:])


def test_no_penalty_leaves_the_reward_alone() -> None:
    env = TransformedEnv(PointNavEnv([64], seed=0), Compose(RewardPenalty(0)))
    steps = env.rollout(50, break_when_any_done=False)["next"]
    assert steps["cost"].any()
    assert torch.equal(steps["reward"], steps["raw_reward"])


@pytest.mark.parametrize("penalty", [-100.0, float("nan"), float("inf")])
def test_a_bad_penalty_is_refused(penalty: float) -> None:
    with pytest.raises(ValueError, match="penalty: expected a number >= 0, given"):
        RewardPenalty(penalty)


def test_an_environment_without_costs_is_refused() -> None:
    with pytest.raises(ValueError, match="expected an environment that publishes 'cost'"):
        _ = TransformedEnv(GymEnv("Pendulum-v1"), RewardPenalty()).observation_spec


# In the trainer -----------------------------------------------------------------------------------


def penalized(*overrides: str) -> DictConfig:
    return compose_config("experiment=penalty", *overrides)


def test_only_training_is_penalized() -> None:
    config = penalized()
    for chosen, expected in ((True, True), (False, False)):
        env = build_environment(config, batch_size=[64], with_penalty=chosen)
        data = env.rollout(20, break_when_any_done=False)
        assert ("raw_reward" in data["next"]) is expected
        assert bool((data["next", "reward"] == -100).any()) is expected
        assert data["next", "cost"].any()
        assert data["next", "episode_reward"].min() > -100


@pytest.mark.parametrize(("number", "paid"), [("0", None), ("0.0", None), ("7", 7.0)])
def test_a_number_is_a_penalty_too_and_zero_is_none(number: str, paid: float | None) -> None:
    config = compose_config(f"env.penalty={number}")
    env = build_environment(config, batch_size=[2], with_penalty=True)
    penalties = [
        transform.penalty for transform in env.transform if isinstance(transform, RewardPenalty)
    ]
    assert penalties == ([] if paid is None else [paid])


def test_a_run_learns_from_the_penalty_and_reports_the_raw_return(tmp_path: Path) -> None:
    config = penalized(
        "env.penalty.penalty=1e6",
        "collector.total_frames=256",
        "training.warmup_frames=192",
        "training.update_ratio=0.05",
        "training.log_interval=64",
        "evaluation.episodes=8",
        "+env.base.max_steps=12",
        "figures=none",
        "logger=csv",
    )
    summary = train(config, RunFolder.create(tmp_path / "run"))
    assert sum(summary["training_violations"].values()) > 0

    def last(name: str) -> float:
        rows = (tmp_path / "run" / "metrics" / "scalars" / f"{name}.csv").read_text().splitlines()
        return float(rows[-1].split(",")[1])

    assert last("loss/qvalue") > 1e4
    assert last("train/return") > -100
    for report in summary["evaluation"].values():
        assert report["return_mean"] > -100
