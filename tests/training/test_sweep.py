import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf
from scipy import stats

from cnfp_torchrl.commands.sweep import MEANS, TABLE, mean_rows, report, run_rows
from cnfp_torchrl.commands.sweep_folders import (
    MULTIRUN,
    config_arguments,
    planned_runs,
    run_name,
    with_common_keys,
)
from cnfp_torchrl.training.run_folder import SUMMARY, RunFolder
from cnfp_torchrl.training.sweep import OVERRIDES, Mean, read_sweep, varied


def make_run(
    sweep: Path, name: str, *overrides: str, score: float | None = None, **summary: Any
) -> RunFolder:
    """Make the folder of a run of 100 steps, which is done if it has a score."""
    folder = RunFolder(sweep / name)
    (folder.path / OVERRIDES).parent.mkdir(parents=True)
    OmegaConf.save(["collector.total_frames=100", *overrides], folder.path / OVERRIDES)
    folder.save_config(OmegaConf.create({"collector": {"total_frames": 100}}))
    if score is not None:
        constraints = {"wall": {"largest_relaxation": 0.25}}
        content = {
            "score": score,
            "return_mean": 10 * score,
            "violations": {"wall": 0, "battery": None},
            "constraints": constraints,
            "seconds": 2.0,
            "steps": 100,
        }
        folder.save_summary(content | summary)
    return folder


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    """A sweep over two flows and three seeds, of which one failed, one runs and one was killed."""
    for seed, score in enumerate([0.1, 0.4, 0.7]):
        make_run(tmp_path, f"{seed}_exact", "flow=exact", f"seed={seed}", score=score)
    make_run(tmp_path, "3_squash", "flow=squash", "seed=0").save_failure(ValueError("no such wall"))
    make_run(tmp_path, "4_squash", "flow=squash", "seed=1")
    make_run(tmp_path, "10_squash", "flow=squash", "seed=2", score=0.5, violations={"wall": 3})
    return tmp_path


def test_a_table_says_what_was_varied_and_what_came_of_it(sweep: Path) -> None:
    runs = read_sweep(sweep)
    assert varied(runs) == ["flow", "seed"]
    assert [run.path.name.partition("_")[0] for run in runs] == ["0", "1", "2", "3", "4", "10"]
    header, *rows = run_rows(runs)
    table = [dict(zip(header, row, strict=True)) for row in rows]
    assert [row["score"] for row in table] == ["0.1", "0.4", "0.7", "-", "-", "0.5"]
    assert [row["violations"] for row in table] == ["0", "0", "0", "-", "-", "3"]
    assert table[0]["relaxation"] == "0.25"
    assert [row["state"].partition(":")[0] for row in table] == [
        *["done"] * 3,
        "failed",
        "stopped",
        "done",
    ]
    assert "no such wall" in table[3]["state"]


def test_means_and_intervals_are_over_the_seeds_that_are_done(sweep: Path) -> None:
    header, *rows = mean_rows(read_sweep(sweep))
    exact, squash = (dict(zip(header, row, strict=True)) for row in rows)
    assert (exact["flow"], exact["runs"], exact["done"], exact["score"]) == (
        "exact",
        "3",
        "3",
        "0.4",
    )
    assert (squash["flow"], squash["runs"], squash["done"], squash["+-"]) == (
        "squash",
        "3",
        "1",
        "-",
    )


@pytest.mark.parametrize("count", [2, 5, 40])
def test_an_interval_is_student_s(count: int) -> None:
    values = np.random.default_rng(0).normal(size=count)
    mean = Mean.of(values.tolist())
    expected = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert mean.half_width is not None
    assert mean.value - mean.half_width == pytest.approx(expected.low)
    assert mean.value + mean.half_width == pytest.approx(expected.high)


def test_the_state_of_a_run_is_that_of_its_folder(sweep: Path) -> None:
    running = RunFolder.resume(sweep / "4_squash")
    # Done once, and now extended.
    OmegaConf.save({"collector": {"total_frames": 200}}, sweep / "2_exact" / "config.yaml")
    (sweep / "2_exact" / "checkpoints").mkdir()
    (sweep / "2_exact" / "checkpoints" / "state-000000000100.pt").touch()
    states = {run.path.name: (run.state, run.reason) for run in read_sweep(sweep)}
    assert states["4_squash"] == ("running", "")
    assert states["2_exact"] == ("stopped", "at step 100")
    running.close()
    assert read_sweep(sweep)[4].state == "stopped"


def planned(tmp_path: Path, *overrides: str, sweeper: str = "x.BasicSweeper") -> dict[Path, Any]:
    """What is known of a sweep's runs from what Hydra writes of it."""
    sources = [{"path": "/conf", "provider": "main"}, {"path": "/mine", "provider": "command-line"}]
    settings = {
        "sweeper": {"_target_": sweeper, "params": {"optim.lr": "0.1,0.2"}},
        "overrides": {"task": list(overrides)},
        "job": {"config": {"override_dirname": {"exclude_keys": ["collector.total_frames"]}}},
        "runtime": {"config_sources": sources},
    }
    OmegaConf.save({"hydra": settings}, tmp_path / MULTIRUN)
    return planned_runs(tmp_path)


def test_runs_that_never_began_are_told(tmp_path: Path) -> None:
    given = ["collector.total_frames=100", "seed=range(2)", "+a.b='x y',null"]
    plan = planned(tmp_path, *given)
    assert len(plan) == 8
    assert [path.name for path in plan][:2] == ["0_lr-0.1_seed-0_b-x-y", "1_lr-0.1_seed-0_b-null"]
    first = ["optim.lr=0.1", "collector.total_frames=100", "seed=0", "+a.b='x y'"]
    assert next(iter(plan.values())) == first
    make_run(tmp_path, "0", "optim.lr=0.1", "seed=0", "+a.b='x y'", score=0.5)
    states = [run.state for run in read_sweep(tmp_path, plan)]
    assert states == ["done", *["not started"] * 7]
    assert config_arguments(tmp_path) == ["--config-dir", "/mine"]


def test_of_a_study_and_of_patterns_no_runs_are_planned(tmp_path: Path) -> None:
    assert planned_runs(tmp_path) == {}
    assert config_arguments(tmp_path) == []
    assert planned(tmp_path, "seed=0,1", sweeper="x.OptunaSweeper") == {}
    assert planned(tmp_path, "flow=glob(*)") == {}


def test_a_report_leaves_tables_and_a_figure(sweep: Path) -> None:
    text = report(sweep)
    assert "no such wall" in text
    for name in (TABLE, MEANS, "sweep.png"):
        assert (sweep / name).stat().st_size
        assert str(sweep / name) in text
    assert (sweep / TABLE).read_text().splitlines()[0].startswith("flow,seed,score,")


def test_a_task_without_a_score_is_told_by_its_return(tmp_path: Path) -> None:
    make_run(tmp_path, "0_a", "seed=0", score=0.5)
    summary = json.loads((tmp_path / "0_a" / SUMMARY).read_text())
    RunFolder(tmp_path / "0_a").save_summary(summary | {"score": None})
    assert read_sweep(tmp_path)[0].score == 5.0


def test_a_folder_without_runs_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="folder: expected that of a sweep"):
        read_sweep(tmp_path)


NAMES = {
    "3_flow-exact_seed-1": ["flow=exact", "steps=7", "seed=1"],
    "3_lr-0.001122": ["optim.lr=0.0011224504152548063"],
    "3_order-battery-obstacle": ["env.order=[battery,obstacle]"],
    "3_obstacle-visible": ["+env/obstacle=visible"],
    "3": ["steps=7"],
}


@pytest.mark.parametrize("name", NAMES)
def test_a_folder_is_named_by_what_was_varied(name: str) -> None:
    assert run_name(3, NAMES[name], ["steps"]) == name


def test_long_names_are_cut_and_stay_apart() -> None:
    names = {run_name(number, [f"a={'x' * 300}"], []) for number in range(3)}
    assert len(names) == 3
    assert max(map(len, names)) <= 80


def test_what_all_runs_have_in_common_is_not_in_the_names() -> None:
    arguments = ["-m", "seed=0,1", "flow=exact", "+env.base.max_steps=3", "optim.lr=choice(1,2)"]
    added = "hydra.job.config.override_dirname.exclude_keys=['flow','env.base.max_steps']"
    assert with_common_keys(arguments) == [*arguments[:4], added, arguments[4]]
    # Hydra's parser takes overrides in one row alone, with options on either side.
    assert with_common_keys([*arguments[1:], "-m"]) == [*arguments[1:4], added, arguments[4], "-m"]
    assert with_common_keys(["seed=0"]) == ["seed=0"]
