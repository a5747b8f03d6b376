"""Real sweeps, in processes of their own."""

import csv
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from cnfp_torchrl.commands.sweep import main as sweep_command
from cnfp_torchrl.training.interruption import STOP_SIGNALS
from cnfp_torchrl.training.run_folder import STATES, SUMMARY, RunFolder
from tests.entry_points import call_command, run_command

TINY = [
    "collector.total_frames=96",
    "training.warmup_frames=48",
    "training.update_ratio=0.2",
    "training.log_interval=32",
    "evaluation.episodes=1",
    "+env.base.max_steps=8",
    "network.hidden=[8]",
    "figures=none",
    "logger=csv",
]


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "sweep.csv").open() as file:
        return list(csv.DictReader(file))


def test_a_failed_run_stops_no_other_and_is_told_with_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sweep = tmp_path / "a=1,[b] c"
    broken = ["optim.lr=1e30,0.001", "training.update_ratio=1"]
    arguments = ["-m", *TINY, *broken, f"hydra.sweep.dir='{sweep}'"]
    done = run_command(tmp_path, "cnfp-train", *arguments)
    assert done.returncode == 1
    first, second = table(sweep)
    # As soon as it has failed, and not behind the others.
    assert f"{first['folder']}: " in done.stderr.partition("Error executing job")[0]
    assert first["state"].startswith("failed: ")
    assert "nan" in first["state"]
    reason = first["state"].removeprefix("failed: ").partition(": ")[2]
    assert done.stderr.count(reason) == 1
    assert second["state"] == "done"
    assert second["folder"] == "1_lr-0.001"
    assert str(sweep / "sweep.csv") in done.stdout
    assert first["state"] in done.stdout
    printed = done.stdout[done.stdout.index("optim.lr  score") :].splitlines()
    assert all(len(line) <= 100 for line in printed[:3])
    # What refuses to go on with a complete run says nothing of it.
    complete = sweep / second["folder"]
    monkeypatch.chdir(tmp_path)
    assert call_command("cnfp-train", f"resume='{complete}'") == 1
    assert "has finished with 96 steps" in capsys.readouterr().err
    assert RunFolder(complete).load_failure() is None
    assert RunFolder(sweep / first["folder"]).load_failure() is not None


@pytest.fixture
def handlers() -> Iterator[None]:
    """Give back the signals that a sweep in this process takes."""
    before = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("handlers")
def test_a_launcher_that_is_refused_before_the_first_run_is_explained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    wrong = ["hydra/launcher=submitit_local", "+hydra.launcher.partition=none"]
    assert call_command("cnfp-train", "-m", *TINY, "seed=0,1", *wrong) == 1
    told = capsys.readouterr().err
    assert "partition" in told.partition("\n")[0]
    assert "holds no run" not in told


@pytest.fixture(scope="module")
def basic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a sweep over three seeds, one after another."""
    folder = tmp_path_factory.mktemp("basic") / "sweep"
    arguments = ["-m", *TINY, "seed=0,1,2", f"hydra.sweep.dir={folder}"]
    done = run_command(folder.parent, "cnfp-train", *arguments)
    assert done.returncode == 0, done.stderr
    return folder


def results(folder: Path) -> list[dict[str, str]]:
    """The rows of a sweep's table, but for what a clock tells."""
    rows = table(folder)
    for row in rows:
        del row["seconds"]
    return rows


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["parallel", "submitit_local"])
def test_launchers_give_the_runs_that_one_after_another_gives(
    launcher: str, basic: Path, tmp_path: Path
) -> None:
    arguments = ["-m", *TINY, "seed=0,1,2", f"hydra.sweep.dir={tmp_path / 's'}"]
    done = run_command(tmp_path, "cnfp-train", *arguments, f"hydra/launcher={launcher}")
    assert done.returncode == 0, done.stderr
    assert results(tmp_path / "s") == results(basic)
    assert [row["state"] for row in table(basic)] == ["done"] * 3


def begin_side_by_side(sweep: Path, *settings: str) -> subprocess.Popen[str]:
    """Begin a sweep of two processes; return when its first two runs have saved a state."""
    arguments = ["-m", *TINY, *settings, f"hydra.sweep.dir={sweep}", "hydra/launcher=parallel"]
    process = subprocess.Popen(
        [sys.executable, "-m", "cnfp_torchrl.commands.train", *arguments],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    while len({path.parent for path in sweep.glob(f"*/{STATES}/state-*")}) < 2:
        assert process.poll() is None, process.communicate()
        time.sleep(0.1)
    return process


def works_in(folder: Path, process: psutil.Process) -> bool:
    """Tell whether a process holds a run's folder."""
    files = Path(f"/proc/{process.pid}/fd").iterdir()
    return any(file.resolve() == folder.resolve() for file in files)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="processes are told apart by /proc")
def test_a_killed_process_takes_no_run_with_it(tmp_path: Path) -> None:
    sweep = tmp_path / "s"
    longer = ["collector.total_frames=960", "checkpoint.interval=48", "hydra.launcher.n_jobs=2"]
    process = begin_side_by_side(sweep, *longer, "seed=0,1,2")
    workers = psutil.Process(process.pid).children()
    (killed,) = (worker for worker in workers if works_in(sweep / "0_seed-0", worker))
    killed.kill()
    _, told = process.communicate()
    assert process.returncode == 0, told
    assert "a process was killed" in told
    assert [row["state"] for row in table(sweep)] == ["done"] * 3


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(("jobs", "seeds"), [(2, "seed=0,1,2"), (4, "seed=0,1")])
def test_a_signal_stops_runs_side_by_side_when_they_are_saved(
    number: int, jobs: int, seeds: str, tmp_path: Path
) -> None:
    sweep = tmp_path / "s"
    endless = ["collector.total_frames=1000000", "checkpoint.interval=48"]
    process = begin_side_by_side(sweep, *endless, f"hydra.launcher.n_jobs={jobs}", seeds)
    os.killpg(process.pid, number)
    _, told = process.communicate()
    assert process.returncode == 128 + number, told
    assert told.count("stopped and saved at step") == 2
    states = [row["state"].partition(":")[0] for row in table(sweep)]
    assert states == ["stopped", "stopped", "not started"][: len(states)]
    assert len(states) == seeds.count(",") + 1


@pytest.mark.slow
def test_a_study_finds_no_run_that_broke_a_constraint(tmp_path: Path) -> None:
    study = ["hydra/sweeper=study", "hydra.sweeper.n_trials=6", f"hydra.sweep.dir={tmp_path / 's'}"]
    varied = ["flow=exact,unconstrained", "optim.lr=tag(log,interval(1e-4,1e-2))"]
    done = run_command(tmp_path, "cnfp-train", "-m", *TINY, *study, *varied)
    assert done.returncode == 0, done.stderr
    rows = table(tmp_path / "s")
    assert {row["flow"] for row in rows} == {"exact", "unconstrained"}
    assert any(int(row["violations"]) for row in rows)
    found = (tmp_path / "s" / "optimization_results.yaml").read_text()
    assert "flow: exact" in found
    best = max(float(row["score"]) for row in rows if row["violations"] == "0")
    assert float(found.split("best_value:")[1]) == pytest.approx(best, rel=1e-3)


@pytest.mark.slow
def test_a_sweep_that_was_cut_short_goes_on_where_it_lies_now(
    basic: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = results(basic)
    sweep = tmp_path / "moved here"
    shutil.copytree(basic, sweep)
    (sweep / before[1]["folder"] / SUMMARY).unlink()
    shutil.rmtree(sweep / before[2]["folder"])
    sweep_command([str(sweep)])
    states = [row["state"] for row in table(sweep)]
    assert states == ["done", "stopped: at step 96", "not started"]
    sweep_command([str(sweep), "--resume", "--jobs", "2"])
    assert results(sweep) == before, capsys.readouterr()


@pytest.mark.slow
def test_a_job_that_slurm_starts_again_goes_on(
    basic: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(basic / table(basic)[0]["folder"], tmp_path / "run")
    (tmp_path / "run" / SUMMARY).unlink()
    arguments = [*TINY, "seed=0", f"hydra.run.dir={tmp_path / 'run'}"]
    assert "holds ['config.yaml'" in run_command(tmp_path, "cnfp-train", *arguments).stderr
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    again = run_command(tmp_path, "cnfp-train", *arguments)
    assert again.returncode == 0, again.stderr
    assert "goes on at step 96" in again.stderr
