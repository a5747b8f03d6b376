"""Real sweeps, in processes of their own."""

import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest

from cnfp_torchrl.training.run_folder import RunFolder

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


def run(command: str, *arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", f"cnfp_torchrl.commands.{command}", *arguments],
        cwd=cwd,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "sweep.csv").open() as file:
        return list(csv.DictReader(file))


def test_a_failed_run_stops_no_other_and_is_told_with_them(tmp_path: Path) -> None:
    sweep = tmp_path / "a=1,[b] c"
    broken = ["optim.lr=1e30,0.001", "training.update_ratio=1"]
    arguments = ["-m", *TINY, *broken, f"hydra.sweep.dir='{sweep}'"]
    done = run("train", *arguments, cwd=tmp_path)
    assert done.returncode == 1
    # As soon as it has failed, and not behind the others.
    assert "0_lr-1e30: " in done.stderr.partition("Error executing job")[0]
    first, second = table(sweep)
    assert first["state"].startswith("failed: ")
    assert "nan" in first["state"]
    assert second["state"] == "done"
    assert second["folder"] == "1_lr-0.001"
    assert str(sweep / "sweep.csv") in done.stdout
    assert first["state"] in done.stdout
    # What refuses to go on with a complete run says nothing of it.
    complete = sweep / second["folder"]
    refused = run("train", f"resume={complete}", cwd=tmp_path)
    assert refused.returncode == 1
    assert "has finished with 96 steps" in refused.stderr
    assert RunFolder(complete).load_failure() is None
    assert RunFolder(sweep / first["folder"]).load_failure() is not None


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["parallel", "submitit_local"])
def test_launchers_give_the_runs_that_one_after_another_gives(
    launcher: str, tmp_path: Path
) -> None:
    for name in ("basic", launcher):
        folder = f"hydra.sweep.dir={tmp_path / name}"
        done = run("train", "-m", *TINY, "seed=0,1", folder, f"hydra/launcher={name}", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    tables = [table(tmp_path / name) for name in ("basic", launcher)]
    for row in (*tables[0], *tables[1]):
        del row["seconds"]
    assert tables[0] == tables[1]
    assert [row["state"] for row in tables[0]] == ["done", "done"]


@pytest.mark.slow
def test_a_study_finds_no_run_that_broke_a_constraint(tmp_path: Path) -> None:
    study = ["hydra/sweeper=study", "hydra.sweeper.n_trials=6", f"hydra.sweep.dir={tmp_path / 's'}"]
    varied = ["flow=exact,unconstrained", "optim.lr=tag(log,interval(1e-4,1e-2))"]
    done = run("train", "-m", *TINY, *study, *varied, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = table(tmp_path / "s")
    assert {row["flow"] for row in rows} == {"exact", "unconstrained"}
    assert any(int(row["violations"]) for row in rows)
    found = (tmp_path / "s" / "optimization_results.yaml").read_text()
    assert "flow: exact" in found
    best = max(float(row["score"]) for row in rows if row["violations"] == "0")
    assert float(found.split("best_value:")[1]) == pytest.approx(best, rel=1e-3)


@pytest.mark.slow
def test_runs_that_were_not_finished_go_on_when_asked(tmp_path: Path) -> None:
    settings = [*TINY, "seed=0,1", f"hydra.sweep.dir={tmp_path / 's'}"]
    assert run("train", "-m", *settings, cwd=tmp_path).returncode == 0
    before = table(tmp_path / "s")
    (tmp_path / "s" / before[1]["folder"] / "summary.json").unlink()
    run("sweep", "s", cwd=tmp_path)
    assert [row["state"] for row in table(tmp_path / "s")] == ["done", "stopped: at step 96"]
    done = run("sweep", "s", "--resume", "--jobs", "2", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    after = table(tmp_path / "s")
    for row in (*before, *after):
        del row["seconds"]
    assert before == after


@pytest.mark.slow
def test_a_job_that_slurm_starts_again_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = [*TINY, f"hydra.run.dir={tmp_path / 'run'}"]
    assert run("train", *arguments, cwd=tmp_path).returncode == 0
    (tmp_path / "run" / "summary.json").unlink()
    assert "holds ['config.yaml'" in run("train", *arguments, cwd=tmp_path).stderr
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    again = run("train", *arguments, cwd=tmp_path)
    assert again.returncode == 0
    assert "goes on at step 96" in again.stderr
