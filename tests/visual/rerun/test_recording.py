"""Recordings and their viewers, with the real processes: what they do to the run, and when."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.request import urlopen

import psutil
import pytest
import rerun as rr
from rerun.experimental import ViewerClient

from cnfp_torchrl.visual.rerun import follow
from cnfp_torchrl.visual.rerun.recording import Recording, open_recording
from cnfp_torchrl.visual.rerun.viewers import (
    RunningViewer,
    SinkError,
    Viewer,
    ViewerWindow,
    WebViewer,
    free_port,
)
from tests.visual.rerun.recorded import RERUN, read, viewer_server

PATIENCE_S = 60.0
"""After which a test has failed. Nothing takes as long by itself, but the machine may be busy."""
DRIVERS = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d")
needs_vulkan = pytest.mark.skipif(
    not any(list(Path(folder).glob("*.json")) for folder in DRIVERS if Path(folder).is_dir()),
    reason="no Vulkan driver; on Debian: apt-get install mesa-vulkan-drivers",
)


def url(port: int) -> str:
    return f"rerun+http://127.0.0.1:{port}/proxy"


def until(condition: Callable[[], object]) -> None:
    # Looks are counted and not seconds: on a busy machine this process, too, has its turn later.
    for _ in range(int(20 * PATIENCE_S)):
        if condition():
            return
        time.sleep(0.05)
    raise AssertionError("waited in vain")


def log(recording: Recording, steps: range) -> None:
    for step in steps:
        recording.stream.set_time("env_step", sequence=step)
        recording.stream.log("x", rr.Scalars(step))
        recording.stream.log("ballast", rr.TextDocument("x" * 1000))


def logged(path: Path) -> list[int]:
    return sorted(read(path, "/x", "Scalars:scalars"))


@pytest.fixture
def port() -> Iterator[int]:
    with viewer_server() as (number, _):
        yield number


def server_of(port: int) -> psutil.Process:
    """Return the process that listens at a port and was started by none of ours."""
    commands = {child: child.cmdline() for child in psutil.Process().children()}
    (found,) = (c for c, line in commands.items() if line[:1] == [RERUN] and str(port) in line)
    return found


def viewer_of(port: int) -> psutil.Process:
    """Return the process at a port that a follower has started, not the relay to it."""
    for child in psutil.process_iter(["cmdline"]):
        line = child.info["cmdline"] or []
        if line[:1] == [RERUN] and line[1] != "-" and str(port) in line:
            return child
    raise AssertionError(f"nobody shows anything at {port}")


def follower_of(path: Path, port: int) -> follow.Follower:
    viewer = RunningViewer(url(port))
    return follow.Follower(path, viewer.relay(), viewer.command(), viewer.addresses)


def helpers() -> list[psutil.Process]:
    """Return all processes that recordings of this process have started."""
    found = []
    for child in psutil.Process().children():
        if is_alive(child) and follow.__file__ in child.cmdline():
            found += [child, *child.children(recursive=True)]
    return found


def is_alive(process: psutil.Process) -> bool:
    """Tell whether a process still runs; one that nobody has waited for yet does not."""
    return process.is_running() and process.status() != psutil.STATUS_ZOMBIE


def stop(process: psutil.Process) -> None:
    process.send_signal(signal.SIGSTOP)
    until(lambda: process.status() == psutil.STATUS_STOPPED)


def test_a_file_holds_what_was_logged(tmp_path: Path) -> None:
    path = tmp_path / "new" / "recording.rrd"
    with open_recording(path) as recording:
        log(recording, range(100))
    recording.close()
    assert logged(path) == list(range(100))


def test_no_file_is_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "recording.rrd"
    path.write_text("precious")
    with pytest.raises(FileExistsError, match=f"{path} exists"):
        open_recording(path)
    assert path.read_text() == "precious"


def test_a_file_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SinkError, match="cannot: "):
        open_recording(tmp_path / "file" / "recording.rrd")


def test_rerun_switched_off_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RERUN", "off")
    with pytest.raises(SinkError, match="RERUN=off"):
        open_recording(tmp_path / "recording.rrd")


@pytest.mark.parametrize(
    "address", ["localhost", "http://127.0.0.1:9876", "rerun+http://127.0.0.1/proxy", "9876"]
)
def test_what_is_no_address_is_refused(address: str) -> None:
    with pytest.raises(SinkError, match=r"rerun\+http://HOST:PORT/proxy, given"):
        RunningViewer(address)


def nobody() -> Viewer:
    return RunningViewer(url(free_port()))


def no_display() -> Viewer:
    return ViewerWindow()


def broken_display() -> Viewer:
    os.environ["DISPLAY"] = ":12345"
    return ViewerWindow()


def bad_argument() -> Viewer:
    return ViewerWindow(arguments=["--headless", "--nonsense"])


def bad_limit() -> Viewer:
    return WebViewer(free_port(), free_port(), memory_limit="much")


def one_port() -> Viewer:
    return WebViewer(9000, 9000)


def impossible_port() -> Viewer:
    return WebViewer(70_000, 9000)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (nobody, "visual=connect: expected a Rerun viewer that listens at .* start one with"),
        (no_display, "visual=spawn: expected a display, .* visual=serve"),
        (broken_display, "visual=spawn: the viewer's window could not be started: .*X server"),
        (bad_argument, "visual=spawn: the viewer's window could not be started"),
        (bad_limit, "visual=serve: the web viewer at .* could not be started"),
        (one_port, "expected two ports, given web_port and port 9000"),
        (impossible_port, "web_port: expected a free port .* given 70000"),
    ],
)
def test_a_viewer_that_cannot_be_had_is_refused(
    make: Callable[[], Viewer], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.setenv(name, "")
    # A busy machine may need longer than usual until the viewer finds out and ends.
    monkeypatch.setattr(follow, "SETTLED_S", PATIENCE_S)
    with pytest.raises(SinkError, match=message):
        open_recording(tmp_path / "recording.rrd", viewer=make())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("which", ["web_port", "port"])
def test_a_busy_port_is_refused(which: str, port: int, tmp_path: Path) -> None:
    viewer = WebViewer(**{"web_port": free_port(), "port": free_port(), which: port})
    with pytest.raises(SinkError, match=rf"viewer.{which}: expected a free port .* given {port}"):
        open_recording(tmp_path / "recording.rrd", viewer=viewer)


def test_a_listener_that_is_no_viewer_is_refused(tmp_path: Path) -> None:
    def answer() -> None:
        connection, _ = listener.accept()
        with connection:
            connection.recv(64)
            connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

    with socket.create_server(("127.0.0.1", 0)) as listener:
        answering = threading.Thread(target=answer)
        answering.start()
        viewer = RunningViewer(url(listener.getsockname()[1]))
        with pytest.raises(SinkError, match="but something else does"):
            open_recording(tmp_path / "recording.rrd", viewer=viewer)
        answering.join()


def test_a_viewer_that_stays_gets_everything(
    port: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "recording.rrd"
    with open_recording(path, viewer=RunningViewer(url(port))) as recording:
        assert len(helpers()) == 2
        log(recording, range(500))
    assert logged(path) == list(range(500))
    assert capfd.readouterr().err == ""
    assert not helpers()


def test_a_stopped_viewer_costs_nothing_but_itself(
    port: int,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "recording.rrd"
    recording = open_recording(path, viewer=RunningViewer(url(port)))
    log(recording, range(100))
    stop(server_of(port))
    started = time.monotonic()
    log(recording, range(100, 3000))
    assert time.monotonic() - started < PATIENCE_S  # nothing waits for the viewer
    assert path.stat().st_size > 100_000
    recording.close()
    assert logged(path) == list(range(3000))
    assert "did not take everything in time" in capfd.readouterr().err
    assert not helpers()


def test_a_viewer_that_goes_is_reported(
    port: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "recording.rrd"
    recording = open_recording(path, viewer=RunningViewer(url(port)))
    (follower, _) = helpers()
    log(recording, range(100))
    server_of(port).kill()
    until(lambda: not is_alive(follower))
    log(recording, range(100, 500))
    recording.close()
    assert logged(path) == list(range(500))
    assert f"is gone; everything is in {path}" in capfd.readouterr().err


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGSTOP])
def test_a_follower_that_is_killed_or_stopped_costs_nothing(
    end: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cnfp_torchrl.visual.rerun.recording._GRACE_S", 0.5)
    path = tmp_path / "recording.rrd"
    recording = open_recording(path, viewer=WebViewer(free_port(), free_port()))
    started = helpers()
    started[0].send_signal(end)
    log(recording, range(500))
    recording.close()
    assert logged(path) == list(range(500))
    until(lambda: not any(map(is_alive, started)))


def test_a_viewer_that_does_not_keep_up_is_given_up(
    port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(follow, "MOST_WAITING", 1 << 20)
    path = tmp_path / "recording.rrd"
    with open_recording(path) as recording:
        log(recording, range(100))
        follower = follower_of(path, port)
        with pytest.raises(follow.Lost, match="does not keep up, 1 MiB are waiting"):
            follower.copy()
        follower.end()


def test_a_finished_file_is_followed_to_its_end(port: int, tmp_path: Path) -> None:
    path = tmp_path / "recording.rrd"
    with open_recording(path) as recording:
        with path.open("rb") as file:
            assert follow.is_being_written(file)
        log(recording, range(100))
    with path.open("rb") as file:
        assert not follow.is_being_written(file)
    follower = follower_of(path, port)
    follower.copy()
    follower.end()


def test_the_web_viewer_is_served_on_loopback_alone(tmp_path: Path) -> None:
    viewer = WebViewer(free_port(), free_port())
    with open_recording(tmp_path / "recording.rrd", viewer=viewer) as recording:
        log(recording, range(10))
        with urlopen(viewer.url) as page:
            assert b"rerun" in page.read().lower()
        addresses = {
            socket.laddr[:2]
            for child in helpers()
            for socket in child.net_connections()
            if socket.status == psutil.CONN_LISTEN
        }
    assert addresses == {("127.0.0.1", viewer.port), ("127.0.0.1", viewer.web_port)}
    assert not viewer.is_listening()
    assert not helpers()


SCRIPT = """
import os, signal, sys, psutil, rerun as rr
from cnfp_torchrl.visual.rerun import RunningViewer, WebViewer, open_recording
folder, connected, server, served, web_port = sys.argv[1], *map(int, sys.argv[2:6])
viewers = {
    "connected": RunningViewer(f"rerun+http://127.0.0.1:{connected}/proxy"),
    "served": WebViewer(web_port, served),
}
recordings = [
    open_recording(f"{folder}/{name}.rrd", viewer=viewer) for name, viewer in viewers.items()
]
os.kill(server, signal.SIGSTOP)
while psutil.Process(server).status() != psutil.STATUS_STOPPED:
    pass
for recording in recordings:
    for step in range(500):
        recording.stream.set_time("env_step", sequence=step)
        recording.stream.log("x", rr.Scalars(step))
        recording.stream.log("ballast", rr.TextDocument("x" * 1000))
print(*(child.pid for child in psutil.Process().children(recursive=True)), flush=True)
if sys.argv[6] == "killed":
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("end", ["killed", "forgotten"])
def test_a_run_that_ends_without_closing_leaves_nothing_behind(
    end: str, port: int, tmp_path: Path
) -> None:
    """Neither beside a viewer that takes nothing any more, nor in a viewer of its own."""
    # Into files: a pipe would stay open in what the run leaves, and reading it wait for that.
    said, errors = tmp_path / "said", tmp_path / "errors"
    with said.open("w") as out, errors.open("w") as err:
        numbers = map(str, (port, server_of(port).pid, free_port(), free_port()))
        command = [sys.executable, "-c", SCRIPT, tmp_path, *numbers, end]
        done = subprocess.run(command, stdout=out, stderr=err, check=False)
    expected = 0 if end == "forgotten" else -signal.SIGKILL
    assert done.returncode == expected, errors.read_text()
    started = [int(number) for number in said.read_text().split()]
    # Two helpers that write and follow for the first, and the viewer besides for the second.
    assert len(started) == 2 + 3
    found = [psutil.Process(number) for number in started if psutil.pid_exists(number)]
    until(lambda: not any(map(is_alive, found)))
    if end == "forgotten":
        for name in ("connected", "served"):
            assert logged(tmp_path / f"{name}.rrd") == list(range(500))


@needs_vulkan
@pytest.mark.parametrize("fate", ["kept", "stopped", "killed"])
def test_a_window_shows_the_recording_and_stays(
    fate: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    number = free_port()
    path = tmp_path / "recording.rrd"
    viewer = ViewerWindow(port=number, arguments=["--headless"])
    recording = open_recording(path, viewer=viewer)
    window = viewer_of(number)

    def last() -> list[int]:
        state = ViewerClient.connect(url(number)).get_state()
        return [t.end for recording in state.recordings for t in recording.timelines]

    try:
        # More than a portion, so that some of it is shown before the end.
        log(recording, range(500))
        until(lambda: any(last()))
        if fate == "stopped":
            stop(window)
        if fate == "killed":
            window.kill()
        # More than a pipe holds.
        log(recording, range(500, 3000))
        recording.close()
        assert logged(path) == list(range(3000))
        error = capfd.readouterr().err
        if fate == "kept":
            until(lambda: last() == [2999])
            assert error == ""
        else:
            assert f"everything is in {path}" in error
        assert window.is_running() == (fate != "killed")
    finally:
        if window.is_running():
            window.kill()
