"""``cnfp-new`` writes a task that passes its own test and trains, and writes over nothing."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import cnfp_torchrl
from cnfp_torchrl.commands.new import new_task
from tests.entry_points import call_command

NAME = "task_of_the_test"
SHORTER = {
    "cnfp-audit": ["batch=8", "audit.states=8", "audit.actions=8", "audit.steps=20"],
    "cnfp-train": [
        "collector.total_frames=64",
        "training.warmup_frames=32",
        "training.update_ratio=0.1",
        "evaluation.episodes=4",
        "hydra.run.dir=run",
        "figures=none",
    ],
    "cnfp-evaluate": ["evaluation.episodes=2"],
    "cnfp-explain": [],
}


@pytest.fixture
def parent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    for module in [name for name in sys.modules if name.partition(".")[0] == NAME]:
        del sys.modules[module]


def files_in(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_what_is_said_to_do_next_works(
    parent: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call_command("cnfp-new", NAME) == 0
    *written, last = capsys.readouterr().out.splitlines()
    assert sorted(map(Path, written)) == sorted(
        path.relative_to(parent) for path in files_in(parent)
    )
    change, export, test, *commands = (line.split() for line in last.split(": ")[1].split("; "))
    assert (change, export) == (["cd", NAME], ["export", "PYTHONPATH=."])
    monkeypatch.chdir(parent / NAME)
    monkeypatch.syspath_prepend(parent / NAME)

    assert test[0] == "python"
    source = Path(cnfp_torchrl.__file__).parents[1]
    tested = subprocess.run(
        [sys.executable, *test[1:], "-q", "-p", "no:cacheprovider"],
        env=os.environ | {"PYTHONPATH": f".{os.pathsep}{source}", "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert tested.returncode == 0, tested.stdout + tested.stderr
    assert "3 passed" in tested.stdout

    assert [command for command, *_ in commands] == ["cnfp-audit", "cnfp-train"]
    for command, *arguments in commands:
        assert call_command(command, *arguments, *SHORTER[command]) == 0
    trained = capsys.readouterr().out
    assert "no flaw found" in trained
    assert "violations: speed 0" in trained
    # A run names the package that is to be trusted with it.
    for command in trained.splitlines()[-1].removeprefix("next: ").split("; "):
        command, *arguments = command.replace("'", "").split()
        assert call_command(command, *arguments, *SHORTER[command]) == 0
    assert "speed" in capsys.readouterr().out


@pytest.mark.parametrize("kind", ["folder", "empty folder", "file", "link that leads nowhere"])
def test_what_is_there_is_not_touched(
    kind: str, parent: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    there = parent / NAME
    if kind == "folder":
        new_task(NAME)
        (there / "notes.txt").write_text("of the user's own")
    elif kind == "empty folder":
        there.mkdir()
    elif kind == "file":
        there.write_text("of the user's own")
    else:
        there.symlink_to("nowhere")
    before = files_in(parent)
    assert call_command("cnfp-new", NAME) == 2
    assert f"{NAME}: expected a new folder" in capsys.readouterr().err
    assert files_in(parent) == before
    assert list(parent.iterdir()) == [there]


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("my-task", "identifier"),
        ("my task", "identifier"),
        ("2d", "identifier"),
        ("", "identifier"),
        ("../up", "identifier"),
        ("a.b", "identifier"),
        ("größe", "identifier"),
        ("class", "identifier"),
        ("__main__", "identifier"),
        ("null", "a value"),
        ("true", "a value"),
        ("torch", "module"),
        ("test", "module"),
        ("sys", "module"),
        ("cnfp_torchrl", "module"),
        ("point_nav", "configuration"),
        ("obstacle", "configuration"),
    ],
)
def test_a_name_that_would_not_work_is_refused(
    name: str, reason: str, parent: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call_command("cnfp-new", name) == 2
    said = capsys.readouterr().err
    assert said.startswith("cnfp-new: error: name: expected")
    assert reason in said
    assert repr(name) in said
    assert said.count("\n") == 1
    assert not list(parent.iterdir())


def test_a_folder_that_cannot_be_written_in_is_named(parent: Path) -> None:
    with pytest.raises(OSError, match="nowhere"):
        new_task(NAME, parent / "nowhere")
