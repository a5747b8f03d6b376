"""``visual=...`` of the commands: what is recorded, and what it changes in the run: nothing."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from rerun.chunk import RrdReader
from tensordict import TensorDictBase

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.training.agent import build_environment, load_actor
from cnfp_torchrl.training.callbacks import show_episodes
from cnfp_torchrl.training.episodes import record_episode
from cnfp_torchrl.training.run_folder import SUMMARY, RunFolder
from cnfp_torchrl.training.settings import EvaluationSettings
from cnfp_torchrl.training.train import train
from cnfp_torchrl.visual.rerun import Recording
from tests.visual.rerun.recorded import compare, read, viewer_server

from .conftest import TINY, TinyRun

FILE = ["visual=file", "visual.samples=16"]


def steps_of(path: Path, entity: str, timeline: str = "env_step") -> list[int]:
    """Return the steps of a timeline at which an entity was logged."""
    found: list[int] = []
    for chunk in RrdReader(str(path)).stream().filter(content=entity):
        batch = chunk.to_record_batch()
        if timeline in batch.schema.names:
            found += batch.column(timeline).to_pylist()
    return sorted(found)


OFF = """
import sys
from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.train import train
import cnfp_torchrl.commands.evaluate
train(compose_config(*sys.argv[2:]), RunFolder.create(sys.argv[1]))
assert "rerun" not in sys.modules
assert "cnfp_torchrl.visual" not in sys.modules
"""


def test_off_imports_nothing(tmp_path: Path) -> None:
    tiny = ["collector.total_frames=32", "training.warmup_frames=16", "training.update_ratio=0.1"]
    tiny += ["evaluation.episodes=2", "+env.base.max_steps=4"]
    done = subprocess.run(
        [sys.executable, "-c", OFF, tmp_path / "run", *tiny, "logger=none"],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert not list(tmp_path.rglob("*.rrd"))


def test_the_recording_has_each_tenth_step_then_an_episode_and_the_log(tiny_run: TinyRun) -> None:
    folder, _ = tiny_run(*FILE, "collector.total_frames=400", "training.log_interval=160")
    path = folder.path / "recording.rrd"
    # 16 agents are stepped together: 25 steps of each. Then an episode of 12 steps.
    assert steps_of(path, "/explanation") == [0, 160, 320]
    assert steps_of(path, "/explanation", "episode_0") == list(range(12))
    for name in ("violations/obstacle", "loss/qvalue", "loss/actor", "train/alpha"):
        assert steps_of(path, f"/metrics/{name}") == [160, 320, 400], name


@pytest.mark.parametrize(
    ("deterministic", "flow"), [(False, "exact"), (True, "squash"), (False, "unconstrained")]
)
def test_episodes_of_the_trained_policy_follow_the_training(
    deterministic: bool, flow: str, tiny_run: TinyRun
) -> None:
    chosen = ["visual.episodes=2", f"visual.deterministic={deterministic}", f"flow={flow}"]
    folder, _ = tiny_run(*FILE, *chosen)
    path = folder.path / "recording.rrd"
    episodes = [episode_of(folder, number, deterministic) for number in (0, 1)]
    last = {"exact": "3\\ obstacle", "squash": "2\\ obstacle", "unconstrained": "1\\ bounds"}[flow]
    executed, steps = f"/stages/{last}/executed", range(12)
    trained = read(path, executed, "Points2D:positions")
    assert [step for step in trained if step >= 0] == [0, 160]
    for number, episode in enumerate(episodes):
        timeline = f"episode_{number}"
        points = read(path, executed, "Points2D:positions", timeline)
        assert [step for step in points if step >= 0] == list(steps)
        for step in steps:
            np.testing.assert_array_equal(points[step][-1], episode[step]["action"].numpy())
        # An episode's return begins anew, and so does the first one's, whatever was before.
        rewards = torch.stack([step["next", "reward"].squeeze() for step in episode]).double()
        returns = read(path, "/series/return", "Scalars:scalars", timeline)
        found = [returns[step].item() for step in steps]
        np.testing.assert_allclose(found, rewards.cumsum(0).numpy())
        trail = read(path, "/map/trail", "LineStrips2D:strips", timeline)
        assert [len(trail[step][-1]) for step in (0, 1)] == [1, 2]


def test_a_stream_that_fails_costs_no_results(
    tiny_run: TinyRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, expected = tiny_run()

    def fail(*_: Any) -> None:
        raise OSError("no stream")

    monkeypatch.setattr("cnfp_torchrl.visual.rerun.run_stream.EpisodeStream.__call__", fail)
    with pytest.raises(OSError, match="no stream"):
        tiny_run(*FILE)
    folder = RunFolder.open(tmp_path / "run1")
    assert json.loads((folder.path / SUMMARY).read_text())["evaluation"] == expected["evaluation"]
    assert steps_of(folder.path / "recording.rrd", "/explanation") == [0, 160]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_evaluation_that_fails_costs_neither_checkpoint_nor_recording(
    error: type[BaseException], tiny_run: TinyRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise error("no evaluation")

    closed = []
    close = Recording.close

    def spied(self: Recording) -> None:
        closed.append(self.path)
        close(self)

    monkeypatch.setattr("cnfp_torchrl.training.train.evaluate_seeded", fail)
    monkeypatch.setattr(Recording, "close", spied)
    with pytest.raises(error, match="no evaluation"):
        tiny_run(*FILE)
    folder = RunFolder.open(tmp_path / "run0")
    assert folder.load_checkpoint()["actor"]
    assert closed == [folder.path / "recording.rrd"]
    assert steps_of(closed[0], "/explanation") == [0, 160]


def test_watching_changes_nothing_and_one_seed_gives_one_recording(tiny_run: TinyRun) -> None:
    unwatched = tiny_run("training.warmup_frames=48")
    one, other, different = (
        tiny_run(*FILE, "training.warmup_frames=48", "visual.every=1", f"seed={seed}")
        for seed in (0, 0, 1)
    )
    path = one[0].path / "recording.rrd"
    assert steps_of(path, "/explanation", "episode_0") == list(range(12))
    for key in ("return_mean", "violations", "evaluation"):
        assert one[1][key] == unwatched[1][key]
    states = [folder.load_checkpoint()["loss"] for folder in (one[0], unwatched[0])]
    assert all(torch.equal(value, states[1][name]) for name, value in states[0].items())
    assert compare(one[0].path / "recording.rrd", other[0].path / "recording.rrd").returncode == 0
    assert (
        compare(one[0].path / "recording.rrd", different[0].path / "recording.rrd").returncode != 0
    )


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["visual=file", "visual.every=0"], "visual.every: expected a whole number >= 1, given 0"),
        (["visual=file", "visual.episodes=0"], "visual.episodes: expected a whole number >= 1"),
        (["visual=file", "visual.projections=[[0,7]]"], "projection"),
        (["visual=spawn"], "visual=spawn: expected a display"),
        (["visual=connect", "visual.viewer.url=rerun+http://127.0.0.1:1/proxy"], "found none"),
        (
            ["visual=serve", "visual.viewer.port=70000"],
            "viewer.port: expected a port from 1 to 65535",
        ),
    ],
)
def test_what_cannot_be_shown_is_refused_before_anything_is_left(
    overrides: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    folder = RunFolder.create(tmp_path / "run")
    with pytest.raises(Exception, match=message):
        train(compose_config(*overrides), folder)
    assert not list(folder.path.iterdir())


def test_a_recording_is_never_overwritten(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run")
    (folder.path / "recording.rrd").write_text("precious")
    with pytest.raises(FileExistsError, match=r"recording\.rrd exists"):
        train(compose_config(*FILE), folder)
    assert (folder.path / "recording.rrd").read_text() == "precious"


@pytest.fixture(scope="module")
def without_viewer(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunFolder, dict[str, Any]]:
    folder = RunFolder.create(tmp_path_factory.mktemp("run") / "run")
    return folder, train(compose_config(*TINY, *FILE, "visual.every=1"), folder)


@pytest.mark.parametrize("fate", [None, signal.SIGSTOP, signal.SIGKILL])
def test_a_viewer_is_shown_the_run_and_cannot_harm_it(
    fate: signal.Signals | None,
    without_viewer: tuple[RunFolder, dict[str, Any]],
    tiny_run: TinyRun,
    tmp_path: Path,
) -> None:
    reference, summary = without_viewer

    def strike() -> None:
        while not list(tmp_path.glob("run0/recording.rrd")):
            time.sleep(0.01)
        server.send_signal(fate)

    with viewer_server() as (port, server):
        if fate is not None:
            threading.Thread(target=strike).start()
        url = f"visual.viewer.url=rerun+http://127.0.0.1:{port}/proxy"
        folder, watched = tiny_run("visual=connect", url, "visual.samples=16", "visual.every=1")
    assert watched["return_mean"] == summary["return_mean"]
    assert compare(folder.path / "recording.rrd", reference.path / "recording.rrd").returncode == 0


def episode_of(folder: RunFolder, number: int, deterministic: bool) -> list[TensorDictBase]:
    config = folder.load_config()
    env = build_environment(config, batch_size=[1], with_anchor=True)
    actor = load_actor(folder, config, env)
    settings = instantiate(config.evaluation)
    return record_episode(env, actor, settings, number, deterministic=deterministic)


def test_an_episode_depends_on_its_seed_alone(tiny_run: TinyRun, tmp_path: Path) -> None:
    folder, _ = tiny_run()
    first, second, again = (episode_of(folder, number, False) for number in (0, 1, 0))
    assert [len(first), len(second)] == [12, 12]
    for step, same, other in zip(first, again, second, strict=True):
        torch.testing.assert_close(step["action"], same["action"], rtol=0, atol=0)
        assert (step["observation"] != other["observation"]).any()

    factory = instantiate({"_target_": "cnfp_torchrl.visual.rerun.RunStream", "episodes": 2})
    path = tmp_path / "recording.rrd"
    show_episodes(folder, EvaluationSettings(episodes=2), factory, path).close()
    for number in (0, 1):
        assert steps_of(path, "/explanation", f"episode_{number}") == list(range(12))
    words = read(path, "/explanation", "TextDocument:text", "episode_1")[7].item()
    assert words.startswith("Trained policy, stochastic, episode 1, step 7 of 12: **")


def test_an_endless_episode_is_cut_off(tiny_run: TinyRun) -> None:
    folder, _ = tiny_run()
    config = folder.load_config()
    env = build_environment(config, batch_size=[2], with_anchor=True)
    actor = load_actor(folder, config, env)
    assert len(record_episode(env, actor, EvaluationSettings(max_steps=5))) == 5
