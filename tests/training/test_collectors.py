"""Collectors in workers: weights arrive, the warm-up is counted for all, constraints hold."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import DictConfig
from tensordict import TensorDict

from cnfp_torchrl.modules import WarmUpPolicy
from cnfp_torchrl.training.agent import build_actor, build_environment
from cnfp_torchrl.training.collectors import (
    MultiSync,
    WorkerCollector,
    WorkerPolicy,
    make_collector,
    shutting_down,
)
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.train import train

MakeConfig = Callable[..., DictConfig]
AGENTS = 8
TINY = [f"env.agents={AGENTS}", "+env.base.max_steps=5", "figures=none"]


def test_workers_act_at_random_as_long_as_they_are_told_to(make_config: MakeConfig) -> None:
    config = make_config(*TINY)
    env = build_environment(config)
    policy = WarmUpPolicy(build_actor(config, env), 100)
    worker = WorkerPolicy(policy)
    state = env.reset()
    assert worker(state.clone())["loc"].eq(0).all()
    # As weights are told to workers: from a tensordict of parameters and buffers.
    told = TensorDict.from_module(worker).data.clone()
    told["acts_at_random"].fill_(False)
    told.to_module(worker)
    assert worker(state.clone())["loc"].ne(0).any()
    assert policy.frames_left == 100


class InThisProcess(WorkerCollector):
    """Counts as those in workers do, with an endless source of batches."""

    def _start(self, make_envs: Any, policy: Any, frames: int) -> Any:
        self.told: list[bool] = []
        self.asked = frames
        outer = self

        class Running:
            def __iter__(self) -> Any:
                batch = TensorDict({"a": torch.zeros(2, AGENTS, 1)}, [2, AGENTS, 1])
                return iter([batch] * (frames // batch.numel()))

            def update_policy_weights_(self, policy: Any) -> None:
                outer.told.append(bool(policy.acts_at_random))

            def shutdown(self) -> None:
                outer.told.append(None)

        return Running()


def test_the_warm_up_is_counted_for_all_workers(make_config: MakeConfig) -> None:
    config = make_config(*TINY)
    env = build_environment(config)
    policy = WarmUpPolicy(build_actor(config, env), 40)
    options = {"workers": 2, "frames_per_batch": AGENTS, "total_frames": 96}
    collector = InThisProcess(lambda worker: env, policy, **options)
    with shutting_down(collector):
        shapes = [batch.shape for batch in collector]
    assert shapes == [(2 * AGENTS, 1)] * 6
    # 16 frames a batch: the third one takes the last of the 40.
    assert collector.told == [True, True, False, False, False, False, None]
    assert policy.frames_left == 0
    resumed = InThisProcess(lambda worker: env, policy, **options)
    resumed.load_state_dict({"frames": 64})
    assert len(list(resumed)) == 2
    assert resumed.asked == 32
    assert resumed.state_dict() == {"frames": 96}
    with pytest.raises(ValueError, match=r"collector\.workers: expected a number >= 1, given 0"):
        MultiSync(lambda worker: env, policy, **{**options, "workers": 0})


KINDS = ["multi_sync", "multi_async", "ray"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of Ray and of processes that it leaves to be collected
@pytest.mark.parametrize("kind", KINDS)
def test_weights_arrive_in_the_workers(kind: str, make_config: MakeConfig) -> None:
    if kind == "ray":
        pytest.importorskip("ray", reason="of the extra 'ray'")
    config = make_config(*TINY, f"collector={kind}", "collector.total_frames=192")
    env = build_environment(config)
    actor = build_actor(config, env)
    policy = WarmUpPolicy(actor, 4 * AGENTS)
    collector = make_collector(config, env, policy)
    seen, acted = [], []
    with shutting_down(collector):
        for batch in collector:
            assert batch.shape[-1] == 1
            assert batch["next", "cost"].sum() == 0
            expected = actor.module[0](batch.select("observation").clone())["loc"]
            acted.append(torch.isclose(batch["loc"], expected, atol=1e-5).all().item())
            seen.append(batch["observation"])
            with torch.no_grad():
                *_, bias = actor.parameters()
                bias += 0.5
    assert sum(each.numel() for each in seen) >= 192 * 5
    # Each worker draws its own starts.
    first = torch.cat(seen[:2]).reshape(-1, 5)
    assert len(first.unique(dim=0)) == len(first)
    if kind == "multi_async":
        assert not acted[0]  # a random one
    else:
        # Random for 32 of 192 frames, of 16 a batch; then by the weights of the batch before.
        assert acted == [False] * 2 + [True] * 10
    if kind == "ray":
        import ray

        assert not ray.is_initialized()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", KINDS)
def test_training(kind: str, make_config: MakeConfig, tmp_path: Path) -> None:
    if kind == "ray":
        pytest.importorskip("ray", reason="of the extra 'ray'")
    config = make_config(
        *TINY,
        f"collector={kind}",
        "collector.total_frames=320",
        "training.warmup_frames=96",
        "training.log_interval=64",
        "training.update_ratio=0.05",
        "evaluation.episodes=4",
        "logger=none",
    )
    summary = train(config, RunFolder.create(tmp_path / "run"))
    assert summary["steps"] == 320
    assert set(summary["violations"].values()) == {0}
