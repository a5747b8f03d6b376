"""``cnfp-view``: which recording, and what it says where it cannot show one."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
import rerun as rr

from cnfp_torchrl.commands.view import main, newest_recording


def recording(path: Path, age: float) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    os.utime(path, (1e9 - age, 1e9 - age))
    return path


def test_the_newest_recording_is_taken(tmp_path: Path) -> None:
    recording(tmp_path / "outputs" / "a" / "recording.rrd", age=2)
    newest = recording(tmp_path / "multirun" / "b" / "0" / "recording.rrd", age=1)
    recording(tmp_path / "elsewhere" / "recording.rrd", age=0)
    assert newest_recording([tmp_path / "outputs", tmp_path / "multirun"]) == newest
    assert newest_recording([tmp_path / "absent", newest]) == newest


@pytest.mark.parametrize(
    ("has_recording", "message"),
    [(False, "found none in outputs, multirun; record one with"), (True, "expected a display")],
)
def test_what_cannot_be_viewed_is_explained(
    has_recording: bool,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    if has_recording:
        recording(tmp_path / "outputs" / "recording.rrd", age=0)
    with pytest.raises(SystemExit) as ended:
        main([])
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("options", [[], ["--follow"]], ids=["finished", "followed"])
def test_a_served_recording_ends_with_the_command(options: list[str], tmp_path: Path) -> None:
    """By SIGTERM, as when a terminal is closed or a service is stopped: no server is left."""
    path = tmp_path / "recording.rrd"
    with rr.RecordingStream("own") as stream:
        stream.save(path)
        stream.log("x", rr.Scalars(0.0))
    command = [sys.executable, "-m", "cnfp_torchrl.commands.view", "--web", *options, str(path)]
    with psutil.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline().startswith(f"{path}, open http")
        while not (started := process.children(recursive=True)):
            assert process.poll() is None
        process.send_signal(signal.SIGTERM)
        assert process.wait() == 128 + signal.SIGTERM
    _, left = psutil.wait_procs(started, timeout=60)
    # One that nobody waits for any more runs no longer.
    assert not [child for child in left if child.status() != psutil.STATUS_ZOMBIE]
