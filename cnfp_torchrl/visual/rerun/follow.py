"""Bring a growing file to a viewer: a program of its own, beside the run that writes the file.

The run holds a lock on the file while it writes (`Recording`). The follower reads the file back, as
fast as the viewer takes it, and hands it to a relay, a process of Rerun's own command line. The
file is the buffer, so that a viewer costs the run neither time nor memory nor data, whatever it
does; and when the lock is free, however the run ended, what is there is all that will be, and the
follower ends. A window that read the file from its own standard input would stand still until then.

Nothing of this package is imported here: as a program it starts at once and takes little memory.
"""

from __future__ import annotations

import fcntl
import json
import os
import select
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import psutil

STARTUP_S = 30.0
"""A viewer that does not listen by then is given up; one that has ended is not waited for."""
PATIENCE_S = 5.0
"""A viewer that takes nothing for so long after the end does not get the rest."""
MOST_WAITING = 1 << 28
"""Bytes that may wait in the relay for a viewer that does not read."""

SETTLED_S = 0.8
"""A window that cannot be opened has ended by then (0.3 s without a display)."""
_POLL_S = 0.1
_CHECK_S = 2.0
_BLOCK = 1 << 16

Address = tuple[str, int]


class Lost(Exception):
    """The viewer will not be given any more; the message completes "the viewer ..."."""


class NotStarted(Exception):
    """The viewer could not be started; the message says why."""


class Follower:
    """Copy a growing file to a viewer.

    Args:
        path: The file.
        relay: The command that hands on to the viewer what it reads from its standard input.
        command: The command that starts the viewer; empty where it runs already.
        addresses: The addresses that the viewer listens at when it is there.
        keeps_viewer: Whether the viewer's process outlives this one.
        settled_s: The seconds after which a viewer that listens and has not ended counts as
            started.

    Raises:
        NotStarted: when the viewer ends, or does not listen in time.
    """

    def __init__(
        self,
        path: Path,
        relay: Sequence[str],
        command: Sequence[str],
        addresses: Sequence[Address],
        *,
        keeps_viewer: bool = False,
        settled_s: float = SETTLED_S,
    ) -> None:
        self._path, self._addresses, self._keeps_viewer = path, addresses, keeps_viewer
        # Whoever ends a follower's group of processes leaves the window that is to stay.
        self.viewer: subprocess.Popen[bytes] | None = None
        if command:
            self.viewer = _start(command, addresses, settled_s, in_own_session=keeps_viewer)
        try:
            self._relay = subprocess.Popen(
                # Unbuffered: to close it must not mean to write what was not taken before.
                relay,
                bufsize=0,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            self._source = path.open("rb")
        except BaseException:
            _end(self.viewer)
            raise
        assert self._relay.stdin is not None
        self._target = self._relay.stdin
        os.set_blocking(self._target.fileno(), False)
        self._rest = memoryview(b"")

    def copy(self) -> None:
        """Pass everything on until nobody writes the file any more, and close the viewer's input.

        Raises:
            Lost: when the viewer is gone, does not keep up, or leaves the rest untaken.
        """
        next_check = progress = time.monotonic()
        while True:
            # Asked before reading: what is written before the end is read after.
            is_complete = not is_being_written(self._source)
            passed = self._pass_on()
            now = time.monotonic()
            if passed or not is_complete:
                progress = now
            if is_complete and not passed and not self._rest:
                break
            if now - progress > PATIENCE_S:
                raise Lost("did not take everything in time")
            if now > next_check:
                self._check()
                next_check = now + _CHECK_S
            if not passed:
                self._wait()
        self._target.close()
        # It ends when the viewer has taken what it hands on.
        try:
            self._relay.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            raise Lost("did not take everything in time") from None
        if not all(map(is_listening, self._addresses)):
            raise Lost("is gone")

    def end(self) -> None:
        """End what was started, except for a viewer that is to be kept, and let go of the file."""
        self._target.close()
        self._source.close()
        _end(self._relay)
        if not self._keeps_viewer:
            _end(self.viewer)

    def _pass_on(self) -> int:
        """Pass on what there is and what the viewer takes without waiting; return how much."""
        if not self._rest:
            self._rest = memoryview(self._source.read(_BLOCK))
        try:
            passed = os.write(self._target.fileno(), self._rest) if self._rest else 0
        except BlockingIOError:
            return 0
        except BrokenPipeError:
            raise Lost("is gone") from None
        self._rest = self._rest[passed:]
        return passed

    def _wait(self) -> None:
        if self._rest:
            select.select([], [self._target.fileno()], [], _POLL_S)
        else:
            time.sleep(_POLL_S)

    def _check(self) -> None:
        ended = [p for p in (self._relay, self.viewer) if p is not None and p.poll() is not None]
        if ended or not all(map(is_listening, self._addresses)):
            raise Lost("is gone")
        try:
            waiting = psutil.Process(self._relay.pid).memory_info().rss
        except psutil.Error:
            raise Lost("is gone") from None
        if waiting > MOST_WAITING:
            raise Lost(f"does not keep up, {MOST_WAITING >> 20} MiB are waiting for it")


def _start(
    command: Sequence[str],
    addresses: Sequence[Address],
    settled_s: float,
    *,
    in_own_session: bool,
) -> subprocess.Popen[bytes]:
    """Start a viewer and wait until it listens."""
    with tempfile.TemporaryFile() as messages:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=messages,
            start_new_session=in_own_session,
        )
        begun = time.monotonic()
        try:
            while (age := time.monotonic() - begun) < STARTUP_S and process.poll() is None:
                if age > settled_s and all(map(is_listening, addresses)):
                    return process
                time.sleep(_POLL_S)
        except BaseException:  # such as that of a signal
            _end(process)
            raise
        _end(process)
        messages.seek(0)
        lines = messages.read().decode(errors="replace").strip().splitlines()
    raise NotStarted(lines[-1] if lines else f"nothing was heard of it in {STARTUP_S:g} s")


def _end(process: subprocess.Popen[bytes] | None) -> None:
    if process is not None:
        process.kill()
        process.wait()


def is_being_written(file: BinaryIO) -> bool:
    """Tell whether a run still writes an open file, which it locks."""
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    fcntl.flock(file, fcntl.LOCK_UN)
    return False


def is_listening(address: Address) -> bool:
    """Tell whether somebody listens at an address."""
    try:
        socket.create_connection(address, 1.0).close()
    except TimeoutError:
        return True  # stopped or slow, which is not gone
    except OSError:
        return False
    return True


def main() -> None:
    """Follow a file for a run, which says how; the first line of output says how the start went."""
    plan = json.loads(sys.argv[1])
    name, path = plan.pop("name"), Path(plan.pop("path"))
    addresses = [(host, port) for host, port in plan.pop("addresses")]
    try:
        follower = Follower(path, addresses=addresses, **plan)
    except NotStarted as reason:
        sys.stdout.write(f"{reason}\n")
        sys.exit(1)
    sys.stdout.write("\n")
    sys.stdout.close()
    try:
        follower.copy()
    except Lost as reason:
        sys.stderr.write(f"{name} {reason}; everything is in {path}\n")
    follower.end()


if __name__ == "__main__":
    main()
