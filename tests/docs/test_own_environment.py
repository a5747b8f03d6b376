"""What docs/own_environment.md shows works as it stands there, in a folder of the user's own."""

import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.entry_points import call_command

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "own_environment.md"
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", DOCUMENT.read_text(), flags=re.DOTALL)
MODULE, CONFIG = Path("my_pendulum.py"), Path("conf/env/my_pendulum.yaml")
SHORTER = {
    "cnfp-train": [
        "collector.total_frames=64",
        "training.warmup_frames=32",
        "training.update_ratio=0.1",
        "evaluation.episodes=4",
    ],
    "cnfp-evaluate": ["evaluation.episodes=2"],
    "cnfp-explain": [],
    "cnfp-audit": ["batch=8", "audit.states=8", "audit.actions=8", "audit.steps=20"],
}


@pytest.fixture
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    CONFIG.parent.mkdir(parents=True)
    yield tmp_path
    sys.modules.pop(MODULE.stem, None)


def run(line: str) -> int:
    """Run a command, with fewer steps than it says, and return its exit status."""
    command, *arguments = shlex.split(line)
    sys.modules.pop(MODULE.stem, None)
    return call_command(command, *arguments, *SHORTER[command])


def test_the_document_runs(own_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said, statuses = [], []
    *blocks, (_, in_python) = BLOCKS
    for language, body in blocks:
        if language == "python":
            with MODULE.open("a") as file:
                file.write(f"\n\n{body}")
        elif language == "yaml":
            with CONFIG.open("a") as file:
                file.write(body)
        elif language == "sh":
            for line in body.splitlines():
                if line.startswith("cnfp-"):
                    statuses.append(run(line))
                    said.append(capsys.readouterr().out)
    trained, evaluated, explained, *audited, slipped = said
    assert statuses == [0, 0, 0, 0, 0, 0, 3]
    assert "violations: power 0" in trained
    assert (own_folder / "run" / "figures" / "learning_curves.png").exists()
    assert "trained, deterministic" in evaluated
    assert "the environment counted no violations" in explained
    assert [("\nuniform " in text, "no flaw found" in text) for text in audited] == [
        (False, True),
        (False, True),
        (True, True),
    ]
    assert "FLAW: power, uniform" in slipped
    exec(compile(in_python, DOCUMENT.name, "exec"), {})


def test_the_lines_are_counted() -> None:
    needed = [
        next(body for kind, body in BLOCKS if kind == language) for language in ("python", "yaml")
    ]
    lines = [line for body in needed for line in body.splitlines() if line]
    assert f"takes {len(lines)} lines of Python and YAML" in " ".join(DOCUMENT.read_text().split())
