"""Where a recording goes: always into a file, and from there to a viewer if one is wanted.

A run writes the file and nothing else; what a live viewer gets is read back from it
(`cnfp_torchrl.visual.stream.feed`).
"""

from __future__ import annotations

import logging
import os
import sys
import threading
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import rerun as rr
import rerun.blueprint as rrb

from cnfp_torchrl.visual.stream.feed import Feed
from cnfp_torchrl.visual.stream.viewers import SinkError, Viewer

_log = logging.getLogger(__name__)

APPLICATION_ID = "cnfp_torchrl"

_PORTION = 1 << 16
"""Bytes that may wait in memory; a few steps."""


class Recording:
    """An open recording: a stream into a file, and its way to a viewer.

    Args:
        stream: log to this.
        path: the file.
        feed: what brings the file's content to a viewer, or None.
    """

    def __init__(self, stream: rr.RecordingStream, path: Path, feed: Feed | None) -> None:
        self.stream = stream
        self.path = path
        self._feed = feed
        self._is_open = True

    def close(self, timeout_s: float = 5.0) -> None:
        """Finish the file, give the viewer what is left, and let go of it.

        Args:
            timeout_s: how long the viewer may take; the file is complete in any case.
        """
        if not self._is_open:
            return
        self._is_open = False
        # The only sink is a file: this waits for the disk and for nobody else.
        self.stream.disconnect()
        if self._feed is not None:
            self._feed.close(timeout_s)

    def stay(self) -> None:
        """Wait for Ctrl-C where somebody at a terminal looks at what ends with the recording."""
        if self._feed is not None and self._feed.ends_with_recording and sys.stdin.isatty():
            sys.stderr.write(f"{self._feed.viewer} stays until you press Ctrl-C\n")
            with suppress(KeyboardInterrupt):
                threading.Event().wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
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
        path: of the file, usually ``recording.rrd``; must not exist.
        viewer: None for the file alone.
        recording_id: by which viewers tell recordings apart; None draws one.
        blueprint: how viewers lay the recording out.

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
    _claim(path)
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
        feed = None if viewer is None else Feed(path, viewer)
    except BaseException:
        stream.disconnect()
        path.unlink()
        raise
    if viewer is not None:
        _log.info("%s shows %s", viewer, path)
    return Recording(stream, path, feed)


def _claim(path: Path) -> None:
    """Make the file, so that nobody else's is overwritten."""
    try:
        if not path.parent.is_dir():
            path.parent.mkdir(parents=True)
        path.touch(exist_ok=False)
    except OSError as error:
        if isinstance(error, FileExistsError) and path.exists():
            raise FileExistsError(
                f"recording: expected a file to be made, but {path} exists; name another"
            ) from None
        raise SinkError(
            f"recording: expected a file that can be written, but {path} cannot: {error.strerror}"
        ) from error
