"""A run that was stopped ends as one that was not."""

import os
import resource
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from omegaconf import DictConfig
from rerun.chunk import RrdReader
from torchrl.envs import DoubleToFloat, EnvBase, GymEnv, TransformedEnv

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.training.checkpoints import CheckpointError, Checkpoints
from cnfp_torchrl.training.environment_state import EpisodesBeginAnewWarning
from cnfp_torchrl.training.interruption import (
    STOP_SIGNALS,
    StopRequest,
    TrainingInterrupted,
    starting_workers,
)
from cnfp_torchrl.training.metrics import Metrics
from cnfp_torchrl.training.resume import resumed_config
from cnfp_torchrl.training.run_folder import STATES, RunFolder
from cnfp_torchrl.training.run_state import BrokenCheckpointWarning
from cnfp_torchrl.training.train import train
from experiments.resume import differences
from tests.payload import Payload

from .conftest import TINY as SHORT

TINY = [*SHORT, "evaluation.episodes=1", "training.update_ratio=0.1", "checkpoint.interval=64"]


class Killed(BaseException):
    """What ends a run at once, as far as that can be done within a process."""


def run_until(config: DictConfig, path: Path, frames: int, *, resume: bool = False) -> None:
    """Train until a number of steps is counted, and no further; no state is saved for it."""
    count = Metrics.add_steps

    def counting(self: Metrics, batch: Any) -> None:
        count(self, batch)
        if self.frames >= frames:
            raise Killed

    folder = RunFolder.resume(path) if resume else RunFolder.create(path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Metrics, "add_steps", counting)
        with pytest.raises(Killed):
            train(config, folder, resume=resume)


def go_on(
    path: Path,
    *overrides: str,
) -> dict[str, Any]:
    folder = RunFolder.resume(path)
    config = resumed_config(folder, compose_config(*overrides), overrides, [__name__])
    return train(config, folder, resume=True)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that was not stopped."""
    path = tmp_path_factory.mktemp("runs") / "whole"
    config = compose_config(*TINY)
    train(config, RunFolder.create(path))
    return path


# Before the first state; between two; in the last step.
@pytest.mark.parametrize("killed_at", [48, 160, 192])
def test_a_killed_run_ends_as_one_that_was_not(killed_at: int, whole: Path, tmp_path: Path) -> None:
    run_until(compose_config(*TINY), tmp_path / "killed", killed_at)
    go_on(tmp_path / "killed")
    assert not differences(whole, tmp_path / "killed")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
def test_a_run_on_a_gpu_goes_on_there(tmp_path: Path) -> None:
    config = compose_config(*TINY, "device=cuda")
    train(config, RunFolder.create(tmp_path / "whole"))
    run_until(config, tmp_path / "killed", 160)
    go_on(tmp_path / "killed")
    assert not differences(tmp_path / "whole", tmp_path / "killed")


OTHERS = {
    "a learned price": ["loss=sac_lagrangian", "flow=unconstrained", "~env.score"],
    "a full buffer": ["replay_buffer.storage.max_size=72", "checkpoint.keep=1"],
    "computed sets": ["training.constraint_bytes=0", "flow=projection"],
    "td3": ["algorithm=td3"],
    "ppo": ["algorithm=ppo", "collector.frames_per_batch=32", "training.warmup_frames=0"],
}


@pytest.mark.parametrize("kind", OTHERS)
def test_runs_of_all_kinds_go_on(kind: str, tmp_path: Path) -> None:
    config = compose_config(*TINY, *OTHERS[kind])
    train(config, RunFolder.create(tmp_path / "whole"))
    run_until(config, tmp_path / "killed", 160)
    go_on(tmp_path / "killed")
    assert not differences(tmp_path / "whole", tmp_path / "killed")


def gymnasium_env(name: str) -> EnvBase:
    env = GymEnv(name, max_episode_steps=20)
    if env.observation_spec["observation"].dtype == torch.float32:
        return env
    return TransformedEnv(env, DoubleToFloat(in_keys=["observation"], out_keys=["observation"]))


def of_gymnasium(name: str) -> DictConfig:
    config = compose_config(*TINY, "flow=unconstrained")
    base = {"_target_": f"{__name__}.gymnasium_env", "name": name}
    config.env = {"agents": 16, "base": base, "geometry": {}}
    return config


def test_episodes_of_mujoco_go_on(tmp_path: Path) -> None:
    config = of_gymnasium("Hopper-v5")
    train(config, RunFolder.create(tmp_path / "whole"))
    run_until(config, tmp_path / "killed", 160)
    go_on(tmp_path / "killed")
    assert not differences(tmp_path / "whole", tmp_path / "killed")


def test_where_an_environment_gives_no_state_its_episodes_begin_anew(tmp_path: Path) -> None:
    config = of_gymnasium("Pendulum-v1")
    run_until(config, tmp_path / "killed", 160)
    with pytest.warns(EpisodesBeginAnewWarning, match=r"step 128 begin anew: .*GymEnv"):
        assert go_on(tmp_path / "killed")["steps"] == 192


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_a_signal_stops_a_run_when_it_is_saved(
    number: int,
    whole: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = RunFolder.create(tmp_path / "stopped")
    count = Metrics.add_steps

    def counting(self: Metrics, batch: Any) -> None:
        count(self, batch)
        if self.frames == 112:
            os.kill(os.getpid(), number)

    handlers = [signal.getsignal(number) for number in STOP_SIGNALS]
    with monkeypatch.context() as patch:
        patch.setattr(Metrics, "add_steps", counting)
        with pytest.raises(TrainingInterrupted, match="step 112") as stopped:
            train(compose_config(*TINY), folder)
    assert f"resume={tmp_path / 'stopped'}" in str(stopped.value)
    assert handlers == [signal.getsignal(number) for number in STOP_SIGNALS]
    go_on(folder.path)
    assert not differences(whole, folder.path)


def test_a_signal_ends_the_evaluation_at_once(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = RunFolder.create(tmp_path / "stopped")
    evaluation = "cnfp_torchrl.training.train.evaluate_seeded"
    with monkeypatch.context() as patch:
        patch.setattr(evaluation, lambda *_, **__: os.kill(os.getpid(), signal.SIGTERM))
        with pytest.raises(TrainingInterrupted, match=r"step 192; go on with: .*stopped"):
            train(compose_config(*TINY), folder)
    assert not folder.is_finished
    go_on(folder.path)
    assert not differences(whole, folder.path)


def test_a_second_signal_stops_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    with StopRequest("ended") as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.signal == signal.SIGTERM
        with pytest.raises(TrainingInterrupted, match="ended") as raised:
            os.kill(os.getpid(), signal.SIGINT)
        assert raised.value.number == signal.SIGINT
    clock = iter([100.0, 100.5, 101.5])
    monkeypatch.setattr(
        "cnfp_torchrl.training.interruption.time", SimpleNamespace(monotonic=clock.__next__)
    )
    with StopRequest("ended"):
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)  # the first once more, passed on by a sweep
        with pytest.raises(TrainingInterrupted):
            os.kill(os.getpid(), signal.SIGINT)


def test_workers_live_through_the_signals_that_stop_a_run() -> None:
    blocked = "import signal; print(*map(int, signal.pthread_sigmask(signal.SIG_BLOCK, [])))"
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [])
    with starting_workers():
        told = subprocess.check_output([sys.executable, "-c", blocked], text=True)
    assert set(STOP_SIGNALS) <= {int(number) for number in told.split()}
    assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == before


def test_a_finished_run_can_be_extended(tmp_path: Path) -> None:
    longer = "collector.total_frames=288"
    train(compose_config(*TINY, longer), RunFolder.create(tmp_path / "whole"))
    train(compose_config(*TINY), RunFolder.create(tmp_path / "extended"))
    before = (tmp_path / "extended" / "summary.json").read_text()
    with pytest.raises(ValueError, match="finished with 192 steps"):
        go_on(tmp_path / "extended")
    with pytest.raises(ValueError, match="at least the 192 steps"):
        go_on(
            tmp_path / "extended",
            "collector.total_frames=96",
        )
    assert (tmp_path / "extended" / "summary.json").read_text() == before
    go_on(
        tmp_path / "extended",
        longer,
    )
    assert not differences(tmp_path / "whole", tmp_path / "extended")
    assert RunFolder(tmp_path / "extended").load_settings()["collector"]["total_frames"] == 288


@pytest.fixture
def stopped(tmp_path: Path) -> Path:
    """The folder of a run that was killed at step 160, with states at 64 and 128."""
    run_until(compose_config(*TINY), tmp_path / "stopped", 160)
    return tmp_path / "stopped"


REFUSED = ["seed=3", "flow=squash", "env.agents=8", "optim.lr=0.1", "experiment=squash"]


@pytest.mark.parametrize("override", REFUSED)
def test_what_would_change_a_run_is_refused(override: str, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    folder.save_config(compose_config(*TINY))
    with pytest.raises(ValueError, match=override.partition("=")[0]):
        resumed_config(folder, compose_config(override), [override])


def test_what_is_as_it_was_may_be_given_again(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    folder.save_config(compose_config(*TINY, "seed=3", "flow=squash"))
    given = ["seed=3", "flow=squash", "visual=file", "checkpoint.interval=7", "resume=x"]
    config = resumed_config(folder, compose_config(*given), given)
    assert (config.seed, config.checkpoint.interval, config.visual.every) == (3, 7, 10)
    assert config.collector.total_frames == 192


def test_a_strangers_run_is_not_trained_further(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    config = compose_config(*TINY)
    config.optim._target_ = "os.system"
    folder.save_config(config)
    with pytest.raises(PermissionError, match=r"optim\._target_"):
        resumed_config(folder, compose_config(), [])


@pytest.mark.parametrize("kind", ["state", "transitions"])
def test_a_strangers_state_runs_no_code(kind: str, stopped: Path, tmp_path: Path) -> None:
    for file in (stopped / STATES).glob(f"{kind}-*"):
        torch.save({"metrics": Payload(tmp_path / "owned")}, file)
    with pytest.raises(CheckpointError, match=kind):
        go_on(stopped)
    assert not (tmp_path / "owned").exists()


def test_an_older_state_serves_where_the_newest_is_broken(
    whole: Path,
    stopped: Path,
) -> None:
    newest = max((stopped / STATES).glob("state-*"))
    newest.write_bytes(newest.read_bytes()[:1000])
    # What a kill leaves of a file that is being written.
    for path in (newest, stopped / "summary.json", *(stopped / "tensorboard").iterdir()):
        path.with_name(f".{path.name}.0123abcd.partial").write_bytes(b"half")
    with pytest.warns(BrokenCheckpointWarning, match=r"state-0*128\.pt.*goes on at step 64"):
        go_on(stopped)
    assert not differences(whole, stopped)
    assert not list(stopped.rglob("*.partial"))


def test_on_a_full_disk_the_states_before_stay(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = RunFolder.create(tmp_path / "full")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    save = Checkpoints.save

    def save_on_a_full_disk(self: Checkpoints, frames: int, components: Any) -> None:
        if frames == 128:
            resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
        try:
            save(self, frames, components)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "save", save_on_a_full_disk)
        with pytest.raises(CheckpointError, match=r"state-0*128.*room"):
            train(compose_config(*TINY), folder)
    states = (folder.path / STATES).glob("*state-*")
    assert [path.name for path in states] == ["state-000000000064.pt"]
    go_on(folder.path)
    assert not differences(whole, folder.path)


def test_a_folder_that_cannot_be_written_to_is_named(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run")
    (folder.path / STATES).write_text("not a folder")
    with pytest.raises(CheckpointError, match=rf"{STATES}.*could not be written"):
        train(compose_config(*TINY), folder)


def test_states_are_few_and_can_be_done_without(tmp_path: Path) -> None:
    short = compose_config(
        *TINY[:-1], "checkpoint.interval=32", "replay_buffer.storage.max_size=48"
    )
    folder = RunFolder.create(tmp_path / "kept")
    train(short, folder)
    names = sorted(path.name for path in (folder.path / STATES).iterdir())
    # The older state, at step 160, needs the last 48 transitions before it.
    kept = {"state": [160, 192], "transitions": [128, 160, 192]}
    assert names == [f"{kind}-{step:012d}.pt" for kind, steps in kept.items() for step in steps]
    for setting in ("checkpoint.interval=null", "checkpoint.keep_last=false"):
        folder = RunFolder.create(tmp_path / setting)
        train(compose_config(*TINY, setting), folder)
        assert not (folder.path / STATES).exists()


def test_a_recording_goes_on_in_a_file_of_its_own(tmp_path: Path) -> None:
    config = compose_config(*TINY, "visual=file", "visual.samples=8")
    run_until(config, tmp_path / "run", 160)
    go_on(tmp_path / "run")
    first, second = (
        {
            step
            for chunk in RrdReader(str(tmp_path / "run" / name)).stream().filter(content="/**")
            if "env_step" in (columns := chunk.to_record_batch()).schema.names
            for step in columns.column("env_step").to_pylist()
        }
        for name in ("recording.rrd", "recording-2.rrd")
    )
    assert min(first) == 0
    assert max(first) <= 160
    assert min(second) == 128
    assert max(second) == 192
    chunks = RrdReader(str(tmp_path / "run" / "recording-2.rrd")).stream().filter(content="/**")
    timelines = {name for chunk in chunks for name in chunk.to_record_batch().schema.names}
    assert any(name.startswith("episode_") for name in timelines)  # of the trained policy
