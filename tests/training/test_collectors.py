"""Collectors in workers: weights arrive, the warm-up is counted for all, constraints hold."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest
import torch
from scipy import stats
from tensordict import TensorDict
from torch import Tensor

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.modules import WarmUpPolicy
from cnfp_torchrl.training.agent import build_actor, build_environment
from cnfp_torchrl.training.collectors import (
    MultiSync,
    WorkerCollector,
    WorkerPolicy,
    make_collector,
    shutting_down,
)
from cnfp_torchrl.training.run_folder import STATES, RunFolder
from cnfp_torchrl.training.train import train

AGENTS = 8
TINY = [f"env.agents={AGENTS}", "+env.base.max_steps=5", "figures=none"]


def test_workers_act_at_random_as_long_as_they_are_told_to() -> None:
    config = compose_config(*TINY)
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


def test_the_warm_up_is_counted_for_all_workers() -> None:
    config = compose_config(*TINY)
    env = build_environment(config)
    policy = WarmUpPolicy(build_actor(config, env), 40)
    options = {"workers": 2, "frames_per_batch": AGENTS, "total_frames": 96}
    collector = InThisProcess(lambda worker, frames: env, policy, **options)
    with shutting_down(collector):
        shapes = [batch.shape for batch in collector]
    assert shapes == [(2 * AGENTS, 1)] * 6
    # 16 frames a batch: the third one takes the last of the 40.
    assert collector.told == [True, True, False, False, False, False, None]
    assert policy.frames_left == 0
    resumed = InThisProcess(lambda worker, frames: env, policy, **options)
    resumed.load_state_dict({"frames": 64})
    assert len(list(resumed)) == 2
    assert resumed.asked == 32
    assert resumed.state_dict() == {"frames": 96}
    with pytest.raises(ValueError, match=r"collector\.workers: expected a number >= 1, given 0"):
        MultiSync(lambda worker, frames: env, policy, **{**options, "workers": 0})


KINDS = ["multi_sync", "multi_async", "ray"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of Ray and of processes that it leaves to be collected
@pytest.mark.parametrize("kind", KINDS)
def test_weights_arrive_in_the_workers(kind: str) -> None:
    if kind == "ray":
        pytest.importorskip("ray", reason="of the extra 'ray'")
    config = compose_config(*TINY, f"collector={kind}", "collector.total_frames=192")
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
    assert sum(batch.numel() for batch in seen) >= 192 * 5
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
def test_training(kind: str, tmp_path: Path) -> None:
    if kind == "ray":
        pytest.importorskip("ray", reason="of the extra 'ray'")
    config = compose_config(
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


def ends_of_episodes(kind: str, *, seed: int, shift: float = 0) -> Tensor:
    """Return the returns and last actions of a fixed policy's episodes, ``(episodes, 3)``."""
    config = compose_config(
        "env.agents=64",
        "+env.base.max_steps=5",
        f"collector={kind}",
        "collector.total_frames=6400",
        f"seed={seed}",
    )
    env = build_environment(config)
    env.set_seed(seed)
    torch.manual_seed(0)  # of the weights
    actor = build_actor(config, env)
    with torch.no_grad():
        *_, bias = actor.parameters()
        bias[0] += shift
    torch.manual_seed(seed)
    collector = make_collector(config, env, actor)
    ends = []
    with shutting_down(collector):
        for batch in collector:
            assert ("constraints", "anchor") in batch.keys(include_nested=True)
            assert batch["next", "cost"].sum() == 0
            ended = batch[batch["next", "done"].squeeze(-1)]
            ends.append(torch.cat([ended["next", "episode_reward"], ended["action"]], -1))
    return torch.cat(ends).double()


def least_likely(first: Tensor, second: Tensor) -> float:
    """Return the smallest p-value of two-sample Kolmogorov-Smirnov tests over the columns."""
    columns = zip(first.unbind(-1), second.unbind(-1), strict=True)
    return min(stats.ks_2samp(a.numpy(), b.numpy()).pvalue for a, b in columns)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_workers_collect_what_one_process_does() -> None:
    single = ends_of_episodes("single", seed=0)
    assert len(single) == 6400 // 5
    assert least_likely(single, ends_of_episodes("single", seed=1, shift=0.5)) < 1e-4
    for kind, seed in (("multi_sync", 2), ("multi_async", 4)):
        several = ends_of_episodes(kind, seed=seed)
        assert len(several) >= 6400 // 5 - 64
        assert len(several.unique(dim=0)) == len(several)
        assert least_likely(single, several) > 1e-3, kind


def begin(kind: str, path: Path) -> tuple[subprocess.Popen[str], list[psutil.Process]]:
    """Begin a run that would take very long; return its process and workers once it is saved."""
    settings = [
        *TINY,
        f"hydra.run.dir={path}",
        f"collector={kind}",
        "collector.total_frames=10000000",
        "training.warmup_frames=0",
        "training.update_ratio=0.05",
        "evaluation.interval=null",
        "checkpoint.interval=160",
    ]
    process = subprocess.Popen(
        [sys.executable, "-m", "cnfp_torchrl.commands.train", *settings],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    while not list((path / STATES).glob("state-*")):
        assert process.poll() is None
        time.sleep(0.1)
    return process, psutil.Process(process.pid).children(recursive=True)


PATIENCE = 300
"""Seconds after which a process counts as one that stays."""


STOPS = [(kind, signal.SIGINT) for kind in KINDS] + [(kind, signal.SIGTERM) for kind in KINDS[:2]]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "number"), STOPS)
def test_a_signal_to_all_processes_stops_a_run_when_it_is_saved(
    kind: str, number: int, tmp_path: Path
) -> None:
    if kind == "ray":
        pytest.importorskip("ray", reason="of the extra 'ray'")
    process, workers = begin(kind, tmp_path / "run")
    os.killpg(process.pid, number)
    _, told = process.communicate(timeout=PATIENCE)
    assert process.returncode == 128 + number, told
    assert "stopped and saved at step" in told
    assert not psutil.wait_procs(workers, timeout=PATIENCE)[1]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["multi_sync", "multi_async"])
def test_no_worker_outlives_a_run_that_is_killed(kind: str, tmp_path: Path) -> None:
    process, workers = begin(kind, tmp_path / "run")
    process.kill()
    process.communicate(timeout=PATIENCE)
    assert not psutil.wait_procs(workers, timeout=PATIENCE)[1]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["multi_sync", "multi_async"])
def test_a_worker_that_is_killed_ends_the_run(kind: str, tmp_path: Path) -> None:
    process, workers = begin(kind, tmp_path / "run")
    killed = next(worker for worker in workers if "spawn_main" in " ".join(worker.cmdline()))
    killed.kill()
    _, told = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    assert "ended with exit code -9 before the run" in told
    assert not psutil.wait_procs(workers, timeout=PATIENCE)[1]
