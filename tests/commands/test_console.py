"""Ctrl-C ends a command with a line, whatever it is at."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from cnfp_torchrl.commands import train
from cnfp_torchrl.training.interruption import TrainingInterrupted
from tests.entry_points import ROOT, SCRIPTS, call_command

AT_THE_IMPORT = """
import os, signal, sys

signal.signal(signal.SIGINT, signal.default_int_handler)  # also where a shell has it ignored

class PressesCtrlC:
    def find_spec(self, name, *_):
        if name == "{package}":
            try:
                os.kill(os.getpid(), signal.SIGINT)
            except KeyboardInterrupt:  # as packages do that try what they can do without
                pass

sys.meta_path.insert(0, PressesCtrlC())
from {module} import {function}
{function}()
"""


@pytest.mark.parametrize(("name", "package"), [("cnfp-train", "torch"), ("cnfp-new", "numpy")])
def test_while_it_is_imported(name: str, package: str, tmp_path: Path) -> None:
    module, _, function = SCRIPTS[name].partition(":")
    code = AT_THE_IMPORT.format(module=module, function=function, package=package)
    done = subprocess.run(
        [sys.executable, "-c", code, "--help"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 130
    assert done.stderr.split("\n") == ["", f"{name}: stopped by Ctrl-C", ""]
    assert not done.stdout


@pytest.fixture
def usual_interrupt() -> Iterator[None]:
    """Answer Ctrl-C as Python does, also where a shell has it ignored, as in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("usual_interrupt")
def test_while_it_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def press() -> None:
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(train, "main", press)
    assert call_command("cnfp-train") == 130
    assert capsys.readouterr().err.split("\n") == ["", "cnfp-train: stopped by Ctrl-C", ""]


def test_while_the_table_of_a_sweep_is_written(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """As the process that started a sweep answers, also when its runs are done."""

    def stop(sweep: Path) -> str:
        raise TrainingInterrupted(signal.SIGINT, f"stopped {sweep}")

    (tmp_path / "0" / ".hydra").mkdir(parents=True)
    (tmp_path / "0" / ".hydra" / "overrides.yaml").write_text("[]")
    monkeypatch.setattr(train, "_main", lambda: train.STARTED.append(tmp_path))
    monkeypatch.setattr(train, "report", stop)
    assert call_command("cnfp-train") == 130
    assert capsys.readouterr().err == f"stopped {tmp_path}\n"
    assert not train.STARTED
