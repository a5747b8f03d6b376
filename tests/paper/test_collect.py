import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.visual.figures import read_scalars
from experiments.paper import collect as collecting
from experiments.paper.collect import collect, commit, settings
from experiments.paper.records import load_records

Run = Callable[..., tuple[RunFolder, dict[str, Any]]]
OVERRIDES = ["experiment=unconstrained", "seed=3", "env.base.max_steps=4", "logger=csv"]


@pytest.fixture
def run(tiny_run: Run) -> RunFolder:
    """A run as the command leaves it, Hydra's own folder included."""
    folder, _ = tiny_run(*OVERRIDES)
    (folder.path / ".hydra").mkdir()
    OmegaConf.save(OmegaConf.create(OVERRIDES), folder.path / ".hydra" / "overrides.yaml")
    return folder


def test_a_record_says_what_the_run_left(run: RunFolder, tmp_path: Path) -> None:
    record = collect(run)
    record.save(tmp_path / "data")
    assert load_records(tmp_path / "data") == ([record], [])

    summary = json.loads((run.path / "summary.json").read_text())
    assert (record.method, record.seed, record.steps) == ("unconstrained", 3, 192)
    assert record.overrides == ("env.base.max_steps=4",)
    assert record.training_violations == summary["training_violations"]
    assert record.violations == summary["violations"]
    assert record.violations["obstacle"] > 0
    for mode, outcome in summary["evaluation"].items():
        assert vars(record.evaluation[mode]) == outcome
    logged = read_scalars(run.path / "metrics")
    assert set(record.curves) == set(logged)
    for name, (steps, values) in logged.items():
        assert record.curves[name].steps == tuple(steps)
        assert record.curves[name].values == pytest.approx(tuple(values), rel=1e-5)
    assert record.config == settings(run.load_settings())
    assert record.config["env"]["base"]["max_steps"] == 4
    assert {"python", "torch", "torchrl", "cnfp_torchrl"} <= set(record.versions)
    assert len(record.path(tmp_path / "data").read_bytes()) < 30_000


def test_time_passes_while_training(run: RunFolder) -> None:
    curves = collect(run).curves
    wall, processor = curves["train/seconds"], curves["train/processor_seconds"]
    assert wall.steps == processor.steps
    assert wall.steps[-1] == 192
    assert list(wall.values) == sorted(wall.values)
    assert list(processor.values) == sorted(processor.values)
    assert processor.values[0] > 0


def test_a_run_without_a_method_is_refused(run: RunFolder) -> None:
    OmegaConf.save(OmegaConf.create(["seed=3"]), run.path / ".hydra" / "overrides.yaml")
    with pytest.raises(ValueError, match="expected a run with experiment=METHOD"):
        collect(run)


def test_the_commit_is_known_only_in_a_checkout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(collecting, "__file__", str(tmp_path / "collect.py"))
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    assert commit() is None
    git = ["git", "-c", "user.name=x", "-c", "user.email=x@y", "-C", str(tmp_path)]
    subprocess.run([*git, "init", "-q"], check=True)
    (tmp_path / "file").write_text("1")
    subprocess.run([*git, "add", "file"], check=True)
    subprocess.run([*git, "commit", "-q", "-m", "first"], check=True)
    head = subprocess.run(
        [*git, "rev-parse", "HEAD"], check=True, capture_output=True, text=True
    ).stdout
    clean = commit()
    assert clean is not None
    assert head.startswith(clean)
    (tmp_path / "file").write_text("2")
    assert commit() == f"{clean}-dirty"
