"""The commands, in processes of their own where that matters."""

import json
import shlex
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from tests.entry_points import call_command, run_command

TINY = [
    "collector.total_frames=96",
    "training.warmup_frames=48",
    "training.update_ratio=0.05",
    "evaluation.episodes=2",
    "+env.base.max_steps=5",
    "logger=csv",
    "figures=none",
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Train twice in one place."""
    place = tmp_path_factory.mktemp("runs")
    for _ in range(2):
        done = run_command(place, "cnfp-train", *TINY)
        assert done.returncode == 0, done.stderr
        assert "violations: obstacle 0, battery 0" in done.stdout
    return place


def test_a_second_run_has_a_folder_of_its_own(folder: Path) -> None:
    assert len(list(folder.glob("outputs/*/*/summary.json"))) == 2


def test_everything_of_a_run_is_in_its_folder(folder: Path) -> None:
    (place, _) = folder.glob("outputs/*/*/")
    names = {path.name for path in place.iterdir()}
    assert names >= {"config.yaml", "checkpoint.pt", "summary.json", "metrics", ".hydra"}
    assert [path.name for path in folder.iterdir()] == ["outputs"]
    asked = {path.stem: OmegaConf.load(path) for path in (place / ".hydra").iterdir()}
    assert asked["overrides"] == TINY
    assert asked["config"].evaluation.episodes == 2
    assert asked["hydra"].hydra.job.name == "train"


def test_evaluate_prints_a_table_and_writes_it(folder: Path, tmp_path: Path) -> None:
    (place, _) = folder.glob("outputs/*/*/")
    done = run_command(tmp_path, "cnfp-evaluate", f"run={place}", "evaluation.episodes=3")
    assert done.returncode == 0, done.stderr
    for name in ("trained, stochastic", "trained, deterministic", "safe random", "shortest path"):
        assert name in done.stdout
    (result,) = tmp_path.glob("outputs/evaluations/*/*/evaluation.json")
    policies = json.loads(result.read_text())["policies"]
    assert policies["trained, stochastic"]["violations"] == {"obstacle": 0, "battery": 0}
    assert policies["trained, stochastic"]["episodes"] == 3


def test_sweeps_put_each_run_in_a_folder_of_its_own(tmp_path: Path) -> None:
    done = run_command(tmp_path, "cnfp-train", "-m", "seed=0,1", "flow=exact,squash", *TINY)
    assert done.returncode == 0, done.stderr
    summaries = [
        json.loads(path.read_text()) for path in tmp_path.glob("multirun/*/*/*/summary.json")
    ]
    jobs = {(summary["seed"], summary["flow"]) for summary in summaries}
    command = shlex.join(["cnfp-train", "-m", "seed=0,1", "flow=exact,squash", *TINY])
    assert {summary["command"] for summary in summaries} == {command}
    assert jobs == {(seed, flow) for seed in (0, 1) for flow in ("ExactFlow", "SquashFlow")}


@pytest.mark.parametrize(
    ("command", "arguments", "message"),
    [
        ("cnfp-train", ["flow=perfect"], "exact"),
        ("cnfp-train", ["env.order=[battery,wind]"], "wind"),
        ("cnfp-train", ["nonsense=1"], "nonsense"),
        ("cnfp-train", ["figures._target_=gone.draw"], "figures: expected gone.draw to be"),
        ("cnfp-train", ["visual=spawn"], "visual=spawn: expected a display"),
        ("cnfp-train", ["experiment=lagrangain"], "lagrangian_threshold"),
        ("cnfp-train", ["collector.total_frames=-3"], "collector.total_frames: expected a whole"),
        ("cnfp-audit", ["audit.states=many"], "audit.states: expected a whole number >= 1"),
        ("cnfp-evaluate", [], "run"),
        ("cnfp-evaluate", ["run=/absent"], "/absent"),
    ],
)
def test_wrong_input_is_explained(
    command: str,
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    # In this process; that it is no different in one of its own shows below.
    assert call_command(command, *arguments) != 0
    assert_explained(message, capsys.readouterr().err)
    assert not list(tmp_path.rglob("checkpoint.pt"))


def assert_explained(message: str, said: str) -> None:
    """Check that nothing stands before the cause, and no traceback behind it."""
    assert message in said
    assert message in said.partition("\n")[0] or "Available options" in said
    assert "Traceback" not in said


def test_a_refused_training_leaves_no_folder(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("kept")
    for folder in ("new", "mine"):
        done = run_command(tmp_path, "cnfp-train", *TINY, f"hydra.run.dir={folder}", "optim.lr=-1")
        assert done.returncode == 1
        assert_explained("optim.lr: expected a finite number > 0", done.stderr)
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["notes.txt"]
