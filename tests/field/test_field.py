"""The field's experiments: every method runs, records load, the report draws them, runs go on."""

from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

from experiments.field import random_actions, report, run, safe_control, single_run
from experiments.field.jobs import METHODS, PEER, SAFE_CONTROL, Job, all_jobs
from experiments.field.records import Record, RecordError, read_records

TASK = "half_cheetah_rate"
TINY = (
    *("collector.total_frames=24", "training.warmup_frames=8", "env.agents=2"),
    *("network.hidden=[8]", "replay_buffer.batch_size=8", "evaluation.episodes=1"),
    *("evaluation.interval=null", "checkpoint.interval=null", "+env.base.max_steps=6"),
    "collector.frames_per_batch=8",
)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the records of two short runs."""
    folder = tmp_path_factory.mktemp("data")
    for method in ("hard", "unconstrained"):
        job = Job(TASK, method, 0)
        single_run.do(job, TINY).save(job.path(folder))
    return folder


def test_records_load_as_they_were_saved(data: Path) -> None:
    hard, unconstrained = read_records(data)
    assert (hard.method, unconstrained.method) == ("hard", "unconstrained")
    assert hard.steps == unconstrained.steps == 24
    assert hard.all_violations == 0
    assert hard.relaxed == {"rate": 0.0}
    assert unconstrained.all_violations > 0
    assert (hard.greedy.steps, len(hard.greedy.returns)) == (6, 1)
    assert hard.stochastic.moved > 0 == unconstrained.stochastic.moved
    assert hard.overrides == list(TINY)
    assert hard.milliseconds > 0


@pytest.mark.slow
@pytest.mark.parametrize("task", [TASK, "half_cheetah_power", "hopper_mixed"])
@pytest.mark.parametrize("method", METHODS)
def test_every_method_runs_a_few_steps(task: str, method: str, tmp_path: Path) -> None:
    if method == PEER and not find_spec("stable_baselines3"):
        pytest.skip("needs the extra bench")
    job = Job(task, method, 1)
    single_run.do(job, TINY).save(job.path(tmp_path))
    (record,) = read_records(tmp_path)
    assert method == "unconstrained" or record.all_violations == 0
    assert (record.projections > 0) == ("projection" in method)


def test_what_has_a_record_is_not_run_again(
    data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    jobs = [Job(TASK, "hard", 0), Job(TASK, "unconstrained", 0)]
    before = [job.path(data).read_bytes() for job in jobs]
    assert run.run_all(jobs, data, side_by_side=2, seconds=60, overrides=[]) == ([], [])
    assert "2 of 2 runs have a record" in capsys.readouterr().out
    monkeypatch.setattr("sys.argv", ["single_run", TASK, "hard", "0", "--data", str(data), *TINY])
    single_run.main()
    assert [job.path(data).read_bytes() for job in jobs] == before
    # What has none is left where the time is up, and keeps its place in the order.
    longest = all_jobs(("hopper_mixed", TASK), METHODS, (0, 1))
    failed, left = run.run_all(longest, data, side_by_side=1, seconds=-1, overrides=[])
    assert not failed
    assert left == [job for job in longest if not job.path(data).exists()]


def test_foreign_records_are_refused(data: Path, tmp_path: Path) -> None:
    source = Job(TASK, "hard", 0).path(data)
    moved = Job(TASK, "hard", 7).path(tmp_path)
    moved.parent.mkdir(parents=True)
    moved.write_bytes(source.read_bytes())
    with pytest.raises(RecordError, match=r"seed_7.json: expected at .*seed_0.json"):
        read_records(tmp_path)
    moved.write_text("{}")
    with pytest.raises(RecordError, match=r"seed_7.json: KeyError"):
        Record.read(moved)
    with pytest.raises(FileExistsError):
        Record.read(source).save(source)
    with pytest.raises(ValueError, match=r"method: expected one of \['hard'"):
        Job(TASK, "hart", 0)


def page(folder: Path) -> Path:
    """Return a page with the report's marks."""
    path = folder / "README.md"
    path.write_text(f"before\n{report.BEGIN}\nold\n{report.END}\nafter\n")
    return path


def write_report(data: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    path = page(folder)
    monkeypatch.setattr("sys.argv", ["report", "--data", str(data), "--page", str(path)])
    report.main()
    text = path.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert "\nold\n" not in text
    return text


def test_the_report_draws_what_the_records_say(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = write_report(data, tmp_path, monkeypatch)
    hard, unconstrained = read_records(data)
    rows = {line.split(" | ")[0]: line for line in text.splitlines() if line.startswith("| ")}
    kept = rows[f"| {report.LABELS['hard'].text}"].split(" | ")
    assert kept[1] == "1"
    assert kept[2] == f"{hard.greedy.returns[0]:,.0f}"
    assert kept[4] == "0"
    broken = rows[f"| {report.LABELS['unconstrained'].text}"].split(" | ")
    assert broken[4] == f"{unconstrained.all_violations:,}"
    assert (tmp_path / "images" / "training.png").stat().st_size > 5000
    assert report.TITLES["hopper_mixed"] in text


def test_random_actions_are_kept_and_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = random_actions.Settings(steps=16, agents=4, seed=0)
    result = random_actions.result_of(TASK, settings, tmp_path)
    assert sum(result["violations"].values()) == result["unsound"] == 0
    assert result["steps"] == 16
    assert result["coverage"] == 1
    monkeypatch.setattr(random_actions, "act", None)
    assert random_actions.result_of(TASK, settings, tmp_path) == result
    with pytest.raises(RecordError, match="expected a result of"):
        random_actions.result_of(TASK, random_actions.Settings(17, 4, 0), tmp_path)
    text = write_report(tmp_path, tmp_path, monkeypatch)
    assert f"| `{TASK}` | 16 | 0 | 0.0% | 100.00% |" in text


@pytest.mark.parametrize("layer", [*safe_control.LAYERS, safe_control.CBF_QP])
def test_controllers_are_trained_and_tabulated(
    layer: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(safe_control, "TRAINED", slice(0, 4))
    monkeypatch.setattr(safe_control, "TESTED", slice(995, None))
    threads = torch.get_num_threads()
    for arguments in ([layer, "0", "--epochs", "1"], [safe_control.TIMES]):
        monkeypatch.setattr("sys.argv", ["safe_control", *arguments, "--data", str(tmp_path)])
        monkeypatch.setattr(safe_control, "TURNS", 2)
        safe_control.main()
    torch.set_num_threads(threads)
    (path,) = (tmp_path / SAFE_CONTROL / layer).glob("*.json")
    record = json.loads(path.read_text())
    assert record["violations"] == 0
    assert record["excess"] == {"largest": 0.0, "mean": 0.0, "count": 0.0}
    assert record["epochs"] == len(record["training_cost"]) == int(layer != safe_control.CBF_QP)
    text = write_report(tmp_path, tmp_path, monkeypatch)
    assert f"| {record['objective']:,.1f} | 0 | 0 | 0 |" in text


def test_hardnet_s_own_measure_counts_barriers_broken_for_long() -> None:
    excess = torch.tensor([[0.0, 2e-4], [0.5, 5e-5]])
    tested = safe_control.Costs(torch.zeros(2), 3, 1.0, excess)
    found = safe_control.hardnet_measure(tested)
    assert found["count"] == 1
    assert found["largest"] == pytest.approx(0.2501)
    assert found["mean"] == pytest.approx(float(excess.mean()))
