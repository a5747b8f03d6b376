"""Open a run's recording in a viewer, finished or growing: the command ``cnfp-view``."""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from cnfp_torchrl.commands.extras import needs_extra

with needs_extra("rerun"):
    import psutil

    from cnfp_torchrl.visual.rerun.follow import Follower, Lost, NotStarted, is_being_written
    from cnfp_torchrl.visual.rerun.viewers import (
        PORT,
        WEB_PORT,
        RunningViewer,
        SinkError,
        Viewer,
        ViewerWindow,
        WebViewer,
        free_port,
        has_display,
    )

_FOLDERS = ("outputs", "multirun")


def newest_recording(paths: Sequence[str | Path]) -> Path:
    """Return the recording that was written last.

    Args:
        paths: Recordings, or folders to search.

    Raises:
        FileNotFoundError: when there is none.
    """
    found: list[Path] = []
    for path in map(Path, paths):
        found += [path] if path.is_file() else path.rglob("*.rrd")
    if not found:
        searched = ", ".join(map(str, paths))
        raise FileNotFoundError(
            f"expected a recording, found none in {searched}; record one with: "
            "cnfp-train visual=file"
        )
    return max(found, key=lambda path: path.stat().st_mtime)


def main(arguments: Sequence[str] | None = None) -> None:
    """Open the newest recording, and return when the viewer is closed."""
    parser = argparse.ArgumentParser(
        prog="cnfp-view", description="Open a run's recording in a Rerun viewer."
    )
    parser.add_argument(
        "run",
        nargs="*",
        default=_FOLDERS,
        help="folder of a run, or a recording; the newest of several (default: of all runs here)",
    )
    parser.add_argument("--follow", action="store_true", help="show what a run still records, too")
    target = parser.add_mutually_exclusive_group()
    target.add_argument("--web", action="store_true", help="serve it to a browser instead")
    target.add_argument("--connect", metavar="URL", help="show it in a viewer that runs already")
    parser.add_argument("--memory-limit", default="2GiB", help="of the viewer (%(default)s)")
    given = parser.parse_args(arguments)
    before = signal.signal(signal.SIGTERM, _end)
    try:
        path = newest_recording(given.run)
        viewer = _viewer(given)
        viewer.require()
        advice = f", open {viewer.url} and end with Ctrl-C" if isinstance(viewer, WebViewer) else ""
        sys.stdout.write(f"{path}{advice}\n")
        sys.stdout.flush()
        status = _follow(path, viewer) if given.follow else _open(path, viewer)
    except KeyboardInterrupt:
        return
    except (FileNotFoundError, SinkError, NotStarted, Lost) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
    finally:
        signal.signal(signal.SIGTERM, before)
    sys.exit(status)


def _end(number: int, _: object) -> None:
    """End on a signal, and with this command what it has started, be it a moment ago."""
    for child in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):
            child.kill()
    sys.exit(128 + number)


def _viewer(given: argparse.Namespace) -> Viewer:
    if given.connect:
        return RunningViewer(given.connect)
    if given.web:
        # Another viewer on the usual ports is no reason to refuse: the address is printed.
        ports = free_port(WEB_PORT), free_port(PORT)
        return WebViewer(*ports, memory_limit=given.memory_limit)
    if not has_display():
        raise SinkError(
            "expected a display to open a window on; serve the recording to a browser instead, "
            "with --web"
        )
    return ViewerWindow(memory_limit=given.memory_limit)


def _open(path: Path, viewer: Viewer) -> int:
    with path.open("rb") as file:
        if is_being_written(file):
            sys.stdout.write("a run still records it; see the rest, too, with --follow\n")
            sys.stdout.flush()
    command = viewer.command()
    command = [*command, str(path)] if command else viewer.relay(str(path))
    return subprocess.run(command, check=False).returncode


def _follow(path: Path, viewer: Viewer) -> int:
    follower = Follower(path, viewer.relay(), viewer.command(), viewer.addresses)
    try:
        follower.copy()
        return 0 if follower.viewer is None else follower.viewer.wait()
    finally:
        follower.end()


if __name__ == "__main__":
    main()
