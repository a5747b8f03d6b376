"""Evaluation while training goes on."""

import csv
from pathlib import Path
from typing import Any

import pytest
import torch

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.train import train

from .conftest import TinyRun

EVALUATED = ["evaluation.interval=50", "evaluation.interval_episodes=3"]


def rows(folder: RunFolder, name: str) -> list[tuple[int, float]]:
    path = folder.path / "metrics" / "scalars" / f"{name}.csv"
    with path.open() as file:
        return [(int(step), float(value)) for step, value in csv.reader(file)]


def test_training_goes_the_same_way_with_and_without(tiny_run: TinyRun) -> None:
    folder, summary = tiny_run(*EVALUATED)
    without, plain = tiny_run("evaluation.interval=null")
    # Batches have 16 steps: the first ones that end beyond 50, 100 and 150, and the last one.
    assert [evaluation["step"] for evaluation in summary["evaluations_in_training"]] == [
        64,
        112,
        160,
        192,
    ]
    assert plain["evaluations_in_training"] == []
    assert summary["return_mean"] == plain["return_mean"]
    trained, expected = folder.load_checkpoint()["actor"], without.load_checkpoint()["actor"]
    assert all(torch.equal(trained[name], expected[name]) for name in expected)


def test_what_is_logged_is_what_the_summary_says(tiny_run: TinyRun) -> None:
    folder, summary = tiny_run(*EVALUATED)
    history = summary["evaluations_in_training"]
    for name, key in {"return": "return_mean", "score": "score"}.items():
        expected = [(evaluation["step"], pytest.approx(evaluation[key])) for evaluation in history]
        assert rows(folder, f"evaluation/{name}") == expected
    for name in ("obstacle", "battery"):
        assert [value for _, value in rows(folder, f"evaluation/violations/{name}")] == [0, 0, 0, 0]
        assert all(evaluation["violations"][name] == 0 for evaluation in history)
    assert all(evaluation["episodes"] == 3 for evaluation in history)


def test_the_best_policy_is_that_of_the_best_evaluation(
    tiny_run: TinyRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    from cnfp_torchrl.training import train as training

    reports = iter([(1.0, 0), (3.0, 2), (2.0, 0)])  # the second one breaks rules

    def said(self: Any, frames: int, is_last: bool) -> dict[str, Any] | None:
        if frames not in (64, 112, 160):
            return None
        score, violations = next(reports)
        return {"step": frames, "return_mean": 0.0, "score": score, "violations": {"a": violations}}

    monkeypatch.setattr(training.IntervalEvaluation, "run_if_due", said)
    kept: list[float] = []
    keep = training.BestPolicy._keep_if_better

    def keeping(self: Any, score: float) -> None:
        kept.append(score)
        keep(self, score)

    monkeypatch.setattr(training.BestPolicy, "_keep_if_better", keeping)
    folder, _ = tiny_run("evaluation.interval=50")
    assert kept == [1.0, 2.0]
    assert (folder.path / "best.pt").is_file()


@pytest.mark.parametrize("device", ["gpu", "cuda:99", "meta", 0])
def test_an_unknown_device_is_refused_with_those_there_are(device: Any, tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run")
    with pytest.raises(ValueError, match=r"^device: expected a device of this machine: cpu"):
        train(compose_config(f"device={device}"), folder)
    assert not list(folder.path.iterdir())
