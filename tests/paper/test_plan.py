import dataclasses
import json
from pathlib import Path

import pytest

from experiments.paper.plan import (
    Job,
    PlanError,
    finished_folder,
    fresh_folder,
    known_methods,
    make_jobs,
    still_to_do,
)
from tests.paper.synthetic import make_record


def save_record_of(job: Job, data: Path) -> Path:
    record = make_record(job.method, job.seed, steps=job.steps)
    return dataclasses.replace(record, config=job.settings()).save(data)


def test_every_experiment_is_a_method() -> None:
    assert {"exact", "squash", "unconstrained", "penalty", "lagrangian"} <= set(known_methods())
    assert all(Job(name, 0, 100).settings()["env"] for name in known_methods())


def test_seeds_are_the_outer_loop() -> None:
    jobs = make_jobs(["exact", "squash"], [3, 4], 800, ["optim.lr=0.01"])
    assert [job.name for job in jobs] == [
        "exact, seed 3",
        "squash, seed 3",
        "exact, seed 4",
        "squash, seed 4",
    ]
    settings = jobs[-1].settings()
    assert settings["seed"] == 4
    assert settings["collector"]["total_frames"] == 800
    assert settings["optim"]["lr"] == 0.01
    assert settings["flow"]["_target_"].endswith("SquashFlow")
    assert not {"figures", "logger", "visual", "hydra"} & set(settings)


@pytest.mark.parametrize(
    ("methods", "seeds", "steps", "overrides", "message"),
    [
        (["exct"], [0], 100, [], r"--methods: expected some of \['exact'.*given \['exct'\]"),
        ([], [0], 100, [], r"--methods: expected one or more, each once, given \[\]"),
        (["exact", "exact"], [0], 100, [], "--methods: expected one or more, each once"),
        (["exact"], [], 100, [], "--seeds: expected one or more, each once"),
        (["exact"], [1, 1], 100, [], r"--seeds: expected one or more, each once, given \[1, 1\]"),
        (["exact"], [0], 0, [], "--steps: expected a number >= 1, given 0"),
        (["exact"], [0], 100, ["seed=3"], "'seed=3': expected KEY=VALUE with a key other than"),
        (["exact"], [0], 100, ["collector.total_frames=3"], "collector.total_frames=3"),
        (["exact"], [0], 100, ["hydra.run.dir=x"], "hydra.run.dir=x"),
        (["exact"], [0], 100, ["+figures.x=1"], "figures.x=1"),
        (["exact"], [0], 100, ["optim"], "'optim': expected KEY=VALUE"),
        (["exact"], [0], 100, ["optim.lrate=1"], "exact: Could not override 'optim.lrate'"),
        (["exact"], [0], 100, ["flow=perfect"], "exact: .*perfect"),
    ],
)
def test_a_bad_plan_is_refused(
    methods: list[str], seeds: list[int], steps: int, overrides: list[str], message: str
) -> None:
    with pytest.raises(PlanError, match=message):
        make_jobs(methods, seeds, steps, overrides)


def test_all_reasons_are_told_at_once() -> None:
    with pytest.raises(PlanError) as caught:
        make_jobs(["exct"], [], 0, ["seed=1"])
    assert len(str(caught.value).splitlines()) == 4


def test_what_has_a_record_is_not_done_again(tmp_path: Path) -> None:
    jobs = make_jobs(["exact", "squash"], [0, 1], 800)
    save_record_of(jobs[1], tmp_path)
    assert still_to_do(jobs, tmp_path) == [jobs[0], jobs[2], jobs[3]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": 1600}, r"collector.total_frames \(800, asked for 1600\)"),
        ({"overrides": ("optim.lr=0.5",)}, r"optim.lr \(0.001, asked for 0.5\)"),
        ({"overrides": ("+env.base.max_steps=7",)}, r"max_steps \(absent, asked for 7\)"),
    ],
)
def test_a_record_of_another_run_is_not_taken_for_it(
    change: dict[str, object], message: str, tmp_path: Path
) -> None:
    job = Job("exact", 0, 800)
    path = save_record_of(job, tmp_path)
    with pytest.raises(PlanError, match=message) as caught:
        still_to_do([dataclasses.replace(job, **change)], tmp_path)
    assert str(path) in str(caught.value)


def test_a_broken_record_is_not_written_over(tmp_path: Path) -> None:
    job = Job("exact", 0, 800)
    path = save_record_of(job, tmp_path)
    path.write_text(path.read_text()[:100])
    with pytest.raises(PlanError, match=r"seed_0\.json.*move the file away"):
        still_to_do([job], tmp_path)


def test_folders_of_killed_runs_stay(tmp_path: Path) -> None:
    job = Job("exact", 0, 800)
    folders = [fresh_folder(job, tmp_path) for _ in range(3)]
    (folders[0] / "output.log").write_text("killed")
    assert [folder.name for folder in folders] == ["seed_0", "seed_0_attempt_2", "seed_0_attempt_3"]
    assert finished_folder(job, tmp_path) is None


def test_a_finished_run_without_a_record_is_found(tmp_path: Path) -> None:
    job, other = Job("exact", 1, 800), Job("exact", 1, 900)
    fresh_folder(job, tmp_path)
    folder = fresh_folder(job, tmp_path)
    # A JSON document is also YAML, in which runs keep their configuration.
    (folder / "config.yaml").write_text(json.dumps(job.settings()))
    assert finished_folder(job, tmp_path) is None
    (folder / "summary.json").write_text("{}")
    assert finished_folder(job, tmp_path) == folder
    assert finished_folder(other, tmp_path) is None
    assert finished_folder(Job("exact", 0, 800), tmp_path) is None
