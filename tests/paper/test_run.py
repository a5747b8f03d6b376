"""The sweep: with the real trainer and few steps."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from omegaconf import DictConfig, OmegaConf

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.visual.figures import read_scalars
from experiments import checkout
from experiments.checkout import commit
from experiments.paper.records import Record, RecordError, load_records
from experiments.paper.run import do_run, settings
from tests.training.conftest import TINY

ROOT = Path(__file__).resolve().parents[2]
PAPER = ROOT / "experiments" / "paper"


@pytest.fixture
def config() -> DictConfig:
    return compose_config(*TINY, "experiment=unconstrained", "seed=3", "logger=csv")


def test_the_sweep_is_what_the_kept_records_show() -> None:
    sweep = OmegaConf.load(PAPER / "sweep.yaml")
    params = sweep.hydra.sweeper.params
    records, _ = load_records(PAPER / "data")
    assert {record.method for record in records} == set(params.experiment.split(","))
    assert {str(record.seed) for record in records} == set(params.seed.split(","))
    assert {record.steps for record in records} == {sweep.collector.total_frames}
    known = {path.stem for path in (ROOT / "conf" / "experiment").glob("*.yaml")}
    assert set(params.experiment.split(",")) <= known


def test_a_run_is_done_once_and_its_record_says_what_it_left(
    config: DictConfig, tmp_path: Path
) -> None:
    folder, data = tmp_path / "run", tmp_path / "data"
    # What a killed run leaves is no run, and stays.
    RunFolder.create(folder / "attempt_1").save_config(config)
    assert do_run(config, "unconstrained", ["a=1"], folder, data).startswith("done, ")
    (record,), problems = load_records(data)
    assert problems == []

    attempt = folder / "attempt_2"
    assert sorted(path.name for path in folder.iterdir()) == ["attempt_1", "attempt_2"]
    summary = json.loads((attempt / "summary.json").read_text())
    assert (record.method, record.seed, record.steps) == ("unconstrained", 3, 192)
    assert record.overrides == ("a=1",)
    assert record.training_violations == summary["training_violations"]
    assert record.violations == sum(summary["violations"].values()) > 0
    for policy, outcome in record.evaluation.model_dump().items():
        assert outcome == {name: summary["evaluation"][policy][name] for name in outcome}
    logged = read_scalars(attempt / "metrics")
    assert set(record.curves) == set(logged)
    for name, (steps, values) in logged.items():
        assert record.curves[name].steps == tuple(steps)
        assert record.curves[name].values == pytest.approx(tuple(values), rel=1e-5)
    clock = record.curves["train/processor_seconds"]
    assert clock.steps[-1] == 192
    assert 0 < clock.values[0] <= clock.values[-1]
    assert record.config == settings(RunFolder(attempt).load_settings())
    assert not {"figures", "logger", "visual", "hydra"} & set(record.config)
    assert {"python", "torch", "torchrl", "cnfp_torchrl"} <= set(record.versions)

    path = data / "unconstrained" / "seed_3.json"
    assert len(path.read_bytes()) < 30_000
    before = path.stat().st_mtime_ns
    assert do_run(config, "unconstrained", ["a=1"], folder, data).startswith("done before")
    assert path.stat().st_mtime_ns == before
    # A finished run without a record is not repeated either.
    path.unlink()
    do_run(config, "unconstrained", ["a=1"], folder, data)
    assert Record.read(path) == record
    assert len(list(folder.iterdir())) == 2
    # But one with another configuration is.
    path.unlink()
    config.optim.lr = 0.5
    do_run(config, "unconstrained", [], folder, data)
    assert len(list(folder.iterdir())) == 3
    assert Record.read(path).config["optim"]["lr"] == 0.5


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"collector": {"total_frames": 256}}, r"collector.total_frames \(192, asked for 256\)"),
        ({"env": {"base": {"max_steps": 7}}}, r"env.base.max_steps \(12, asked for 7\)"),
    ],
)
def test_a_record_of_another_run_is_not_taken_for_it(
    change: dict[str, object], named: str, config: DictConfig, tmp_path: Path
) -> None:
    do_run(config, "unconstrained", [], tmp_path / "run", tmp_path / "data")
    other = OmegaConf.merge(config, change)
    assert isinstance(other, DictConfig)
    with pytest.raises(ValueError, match=named) as caught:
        do_run(other, "unconstrained", [], tmp_path / "run", tmp_path / "data")
    path = tmp_path / "data" / "unconstrained" / "seed_3.json"
    assert str(path) in str(caught.value)
    path.write_text(path.read_text()[:100])
    with pytest.raises(RecordError, match=r"seed_3\.json"):
        do_run(config, "unconstrained", [], tmp_path / "run", tmp_path / "data")


def test_a_run_without_a_method_is_refused(config: DictConfig, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="experiment: expected the name of a method"):
        do_run(config, None, [], tmp_path / "run", tmp_path / "data")
    assert list(tmp_path.iterdir()) == []


def test_the_commit_is_known_only_in_a_checkout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkout, "__file__", str(tmp_path / "checkout.py"))
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


def sweep(output: Path, *overrides: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "experiments.paper.run", f"hydra.sweep.dir='{output}'"]
    tiny = [key for key in TINY if not key.startswith("figures")]
    return subprocess.run(
        [*command, *tiny, *overrides], cwd=ROOT, capture_output=True, text=True, check=False
    )


def test_an_unknown_method_starts_nothing(tmp_path: Path) -> None:
    result = sweep(tmp_path / "out", "experiment=exact,exct")
    assert result.returncode == 1
    assert "exct" in result.stderr
    assert not list(tmp_path.rglob("attempt_*"))


@pytest.mark.slow
def test_the_sweep_goes_on_where_it_was_and_past_failures(tmp_path: Path) -> None:
    output = tmp_path / "a b=c"
    first = sweep(output, "experiment=exact", "seed=0")
    assert first.returncode == 0, first.stderr
    more = sweep(output, "experiment=exact", "seed=-1,0,1")
    assert more.returncode == 1
    assert "FAILED: exact, seed -1" in more.stdout
    assert "exact, seed 0: done before" in more.stdout
    records, problems = load_records(output / "data")
    assert problems == []
    assert [(record.method, record.seed) for record in records] == [("exact", 0), ("exact", 1)]
    assert all(record.violations == 0 for record in records)
    assert "192/192" in (output / "runs" / "exact" / "seed_1" / "output.log").read_text()


@pytest.mark.slow
def test_a_diverged_run_is_no_record(tmp_path: Path) -> None:
    diverging = ["training.update_ratio=1", "optim.lr=1e30"]
    result = sweep(tmp_path, "experiment=exact", "seed=0", *diverging)
    assert result.returncode == 1
    assert "nan" in result.stdout
    assert not (tmp_path / "data").exists()
