"""Where a recording goes: into a file, which a program of its own brings to a viewer if asked.

A run writes the file and nothing else (`cnfp_torchrl.visual.rerun.follow`).
"""

from __future__ import annotations

import fcntl
import json
import logging
import os
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, Self

import rerun as rr
import rerun.blueprint as rrb

from cnfp_torchrl.visual.rerun import follow
from cnfp_torchrl.visual.rerun.viewers import SinkError, Viewer

_log = logging.getLogger(__name__)

APPLICATION_ID = "cnfp_torchrl"

_PORTION = 1 << 16
"""Bytes that may wait in memory; a few steps."""

_GRACE_S = follow.PATIENCE_S + 3.0
"""A follower ends within its own patience; longer than this nobody waits for it."""


class Recording:
    """An open recording: a stream into a file, and the viewer that shows it.

    Args:
        stream: The stream to log to.
        path: The file.
        lock: The open and locked file, which says that it still grows.
        viewer: The viewer that shows the recording, or None.
        follower: The process that brings the file to the viewer, or None.
    """

    def __init__(
        self,
        stream: rr.RecordingStream,
        path: Path,
        lock: BinaryIO,
        viewer: Viewer | None,
        follower: subprocess.Popen[str] | None,
    ) -> None:
        self.stream = stream
        self.path = path
        self._lock, self._viewer, self._follower = lock, viewer, follower

    def close(self) -> None:
        """Finish the file, and let the follower give the viewer what is left, for some seconds."""
        # The only sink is a file: this waits for the disk and for nobody else.
        self.stream.disconnect()
        self._lock.close()
        if self._follower is not None:
            _end(self._follower)
        self._follower = None

    def stay(self) -> None:
        """Finish the file, and wait for Ctrl-C where somebody looks at what ends with `close`."""
        self.stream.disconnect()
        if self._viewer is None or self._viewer.stays_open or not self._viewer.command():
            return
        if sys.stdin.isatty():
            sys.stderr.write(f"{self._viewer} stays until you press Ctrl-C\n")
            with suppress(KeyboardInterrupt):
                threading.Event().wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def open_recording(
    path: str | Path,
    *,
    viewer: Viewer | None = None,
    recording_id: str | None = None,
    blueprint: rrb.Blueprint | None = None,
) -> Recording:
    """Open a recording: a new file, and a viewer that shows it while it grows.

    The times of logging are left out, so that the same steps give the same recording.

    Args:
        path: The path of the file, usually ``recording.rrd``; must not exist.
        viewer: The viewer; None for the file alone.
        recording_id: The identifier by which viewers tell recordings apart; None draws one.
        blueprint: The layout of the recording in viewers.

    Raises:
        FileExistsError: when there is a file already.
        SinkError: when the file cannot be written or the viewer cannot be had. A viewer that
            neither listens nor ends is waited for, half a minute.
    """
    path = Path(path)
    if os.environ.get("RERUN", "on").lower() in ("0", "false", "off"):
        raise SinkError(
            f"RERUN: expected the environment variable to be unset, or on, but "
            f"RERUN={os.environ['RERUN']} switches all logging off and the file would stay empty"
        )
    if viewer is not None:
        viewer.require()
    lock = _create(path)
    # In portions of a given size and not, as is usual, by the clock: the same steps, the same file.
    batches = rr.ChunkBatcherConfig.NEVER()
    batches.flush_num_bytes = _PORTION
    stream = rr.RecordingStream(
        APPLICATION_ID, recording_id=recording_id, send_properties=False, batcher_config=batches
    )
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    stream.save(path, default_blueprint=blueprint)
    try:
        follower = None if viewer is None else _start_follower(path, viewer)
    except BaseException:
        stream.disconnect()
        lock.close()
        path.unlink()
        raise
    if viewer is not None:
        _log.info("%s shows %s", viewer, path)
    return Recording(stream, path, lock, viewer, follower)


def _create(path: Path) -> BinaryIO:
    """Make the file, so that nobody else's is overwritten, and lock it for as long as it grows."""
    try:
        if not path.parent.is_dir():
            path.parent.mkdir(parents=True)
        lock = path.open("xb")
    except OSError as error:
        if isinstance(error, FileExistsError) and path.exists():
            raise FileExistsError(
                f"recording: expected a file to be made, but {path} exists; name another"
            ) from None
        raise SinkError(
            f"recording: expected a file that can be written, but {path} cannot: {error.strerror}"
        ) from error
    # Some network file systems have no locks; then a follower takes the file for a finished one.
    with suppress(OSError):
        fcntl.flock(lock, fcntl.LOCK_EX)
    return lock


def _start_follower(path: Path, viewer: Viewer) -> subprocess.Popen[str]:
    """Start the process that brings a file to a viewer, and wait until the viewer is there."""
    plan = {
        "name": str(viewer),
        "path": str(path),
        "relay": viewer.relay(),
        "command": viewer.command(),
        "addresses": viewer.addresses,
        "keeps_viewer": viewer.stays_open,
        "settled_s": follow.SETTLED_S,
    }
    process = subprocess.Popen(
        # As a file, not as a module, which would import all of this package.
        [sys.executable, "-P", follow.__file__, json.dumps(plan)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        # Ctrl-C is meant for the run; and all that the follower started can be ended at once.
        start_new_session=True,
        text=True,
    )
    assert process.stdout is not None
    with process.stdout:
        answer = process.stdout.readline()
    if answer != "\n":
        _end(process)
        raise SinkError(f"{viewer} could not be started: {answer.strip() or 'no reason was given'}")
    return process


def _end(follower: subprocess.Popen[str]) -> None:
    """Wait until a follower has ended, and end what is left of it."""
    try:
        follower.wait(_GRACE_S)
    except subprocess.TimeoutExpired:
        _log.warning("the follower of the recording did not end in time and is ended")
    with suppress(ProcessLookupError):
        os.killpg(follower.pid, signal.SIGKILL)
    follower.wait()
