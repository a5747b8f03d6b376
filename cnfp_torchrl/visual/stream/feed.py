"""From a file that grows to a viewer that may be slow, stopped or gone.

The file is the buffer: a thread reads it back, as fast as the viewer takes it, and hands it to a
relay, a process of Rerun's own command line. So a viewer costs the run neither time nor memory nor
data, whatever it does, and nothing that it does can hang the interpreter's exit.
"""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import psutil

from cnfp_torchrl.visual.stream.viewers import SinkError, Viewer, executable

_log = logging.getLogger(__name__)

_STARTUP_S = 30.0
"""A viewer that does not listen by then is given up; one that has ended is not waited for."""
_SETTLED_S = 0.8
"""A window that cannot be opened has ended by then (0.3 s without a display)."""
_POLL_S = 0.1
_CHECK_S = 2.0
_BLOCK = 1 << 16
_MOST_WAITING = 1 << 28
"""Bytes that may wait in the relay for a viewer that does not read."""
_REAPER = 'read -r _; kill -9 "$@"'
"""Reads until this process closes its end of a pipe, be it by dying, then ends the others."""


class Feed:
    """Bring a growing file to a viewer.

    Args:
        path: the file.
        viewer: started here if it does not run already.

    Raises:
        SinkError: when the viewer cannot be started.
    """

    def __init__(self, path: Path, viewer: Viewer) -> None:
        self._path = path
        self.viewer = viewer
        self._is_complete = threading.Event()
        self._is_given_up = False
        self._process = _start(viewer)
        try:
            # Given the address of a viewer that listens, Rerun hands on to it what it reads.
            self._relay = subprocess.Popen(
                [executable(), "-", *_address(viewer)],
                # Unbuffered: to close it must not mean to write what was not taken before.
                bufsize=0,
                stdin=subprocess.PIPE,
                **_DETACHED,
            )
        except BaseException:
            _end(self._process)
            raise
        self._reaper = _reaper(self._helpers())
        self._thread = threading.Thread(target=self._run, name="rerun-feed", daemon=True)
        self._thread.start()

    @property
    def ends_with_recording(self) -> bool:
        """Whether what somebody may look at is ended by `close`."""
        return self._process is not None and not self.viewer.stays_open

    def close(self, timeout_s: float) -> None:
        """Say that the file is complete, wait until the viewer has it, and end the helpers.

        Args:
            timeout_s: in all.
        """
        self._is_complete.set()
        until = time.monotonic() + timeout_s
        self._thread.join(timeout_s)
        try:
            self._relay.wait(max(until - time.monotonic(), 0))
        except subprocess.TimeoutExpired:
            self._give_up("did not take everything in time")
        self._relay.kill()
        self._thread.join()
        for process in self._helpers():
            _end(process)
        if self._process is not None and self.viewer.stays_open:
            _left_open.append(self._process)
        # After the others, whose numbers are free for anybody from then on.
        _end(self._reaper)

    def _helpers(self) -> list[subprocess.Popen[bytes]]:
        """Return the processes that end with the recording."""
        if self._process is None or self.viewer.stays_open:
            return [self._relay]
        return [self._relay, self._process]

    def _run(self) -> None:
        try:
            self._copy()
        except (_Lost, BrokenPipeError, psutil.NoSuchProcess) as error:
            self._give_up(str(error) if isinstance(error, _Lost) else "is gone")
            self._relay.kill()

    def _copy(self) -> None:
        target = self._relay.stdin
        assert target is not None
        next_check = time.monotonic() + _CHECK_S
        with target, self._path.open("rb") as source:
            while True:
                # Asked before reading: what is written before the end is said is read after.
                was_complete = self._is_complete.is_set()
                block = source.read(_BLOCK)
                _write(target.fileno(), block)
                if time.monotonic() > next_check:
                    self._check()
                    next_check = time.monotonic() + _CHECK_S
                if not block and was_complete:
                    return
                if not block:
                    self._is_complete.wait(_POLL_S)

    def _check(self) -> None:
        ended = self._relay.poll() is not None
        ended |= self._process is not None and self._process.poll() is not None
        if ended or not self.viewer.is_listening():
            raise _Lost("is gone")
        if psutil.Process(self._relay.pid).memory_info().rss > _MOST_WAITING:
            raise _Lost(f"does not keep up, {_MOST_WAITING >> 20} MiB are waiting for it")

    def _give_up(self, why: str) -> None:
        if not self._is_given_up:
            self._is_given_up = True
            _log.warning("%s %s; everything is in %s", self.viewer, why, self._path)


class _Lost(Exception):
    """The viewer will not be given any more."""


_DETACHED: dict[str, Any] = {
    "stdout": subprocess.DEVNULL,
    "stderr": subprocess.DEVNULL,
    # Ctrl-C is meant for the run, which ends its helpers itself.
    "start_new_session": True,
}

_left_open: list[subprocess.Popen[bytes]] = []
"""Windows that stay when the recording ends; Popen complains of processes that are forgotten."""


def _start(viewer: Viewer) -> subprocess.Popen[bytes] | None:
    """Start a viewer that does not run already, and wait until it listens."""
    command = viewer.command()
    if command is None:
        return None
    with tempfile.TemporaryFile() as said:
        options = _DETACHED | {"stderr": said}
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, **options)
        started = time.monotonic()
        while (age := time.monotonic() - started) < _STARTUP_S and process.poll() is None:
            if age > _SETTLED_S and viewer.is_listening():
                return process
            time.sleep(_POLL_S)
        _end(process)
        said.seek(0)
        lines = said.read().decode(errors="replace").strip().splitlines()
    reason = lines[-1] if lines else f"nothing was heard of it in {_STARTUP_S} s"
    raise SinkError(f"{viewer} could not be started: {reason}")


def _address(viewer: Viewer) -> list[str]:
    found = socket.getaddrinfo(viewer.host, viewer.port, type=socket.SOCK_STREAM)
    return ["--bind", str(found[0][4][0]), "--port", str(viewer.port)]


def _reaper(processes: list[subprocess.Popen[bytes]]) -> subprocess.Popen[bytes]:
    """Start a process that ends the others when this one has ended, however it did."""
    numbers = [str(process.pid) for process in processes]
    return subprocess.Popen(
        ["sh", "-c", _REAPER, "sh", *numbers], stdin=subprocess.PIPE, **_DETACHED
    )


def _end(process: subprocess.Popen[bytes] | None) -> None:
    if process is None:
        return
    process.kill()
    process.wait()
    if process.stdin is not None:
        process.stdin.close()


def _write(target: int, block: bytes) -> None:
    rest = memoryview(block)
    while rest:
        rest = rest[os.write(target, rest) :]
