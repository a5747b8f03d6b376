"""Open a recording in a viewer: ``make view``."""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from cnfp_torchrl.visual.stream.viewers import (
    SinkError,
    ViewerWindow,
    WebViewer,
    has_display,
)

_PLACES = ("outputs", "multirun")


def newest_recording(places: Sequence[str | Path]) -> Path:
    """Return the recording that was written last.

    Args:
        places: recordings, or folders to look through.

    Raises:
        FileNotFoundError: when there is none.
    """
    found: list[Path] = []
    for place in map(Path, places):
        found += [place] if place.is_file() else place.rglob("*.rrd")
    if not found:
        looked = ", ".join(str(place) for place in places)
        raise FileNotFoundError(
            f"expected a recording, found none in {looked}; record one with: make train "
            'ARGS="visual=file"'
        )
    return max(found, key=lambda path: path.stat().st_mtime)


def main(arguments: Sequence[str] | None = None) -> None:
    """Open the newest recording, and return when the viewer is closed."""
    parser = argparse.ArgumentParser(
        prog="view", description="Open a recording, by default the newest one, in a Rerun viewer."
    )
    parser.add_argument("place", nargs="*", default=_PLACES, help="a recording, or a folder")
    parser.add_argument("--web", action="store_true", help="serve it to a browser instead")
    parser.add_argument("--memory-limit", default="2GiB", help="of the viewer (%(default)s)")
    given = parser.parse_args(arguments)
    viewer: WebViewer | ViewerWindow
    try:
        path = newest_recording(given.place)
        if not given.web and not has_display():
            raise SinkError(
                "expected a display to open a window on; serve the recording to a browser instead "
                'with --web (make view ARGS="--web")'
            )
        if given.web:
            viewer = WebViewer(memory_limit=given.memory_limit)
        else:
            viewer = ViewerWindow(memory_limit=given.memory_limit)
        viewer.require()
    except (FileNotFoundError, SinkError) as error:
        parser.exit(2, f"view: error: {error}\n")
    where = f", open {viewer.url} and end with Ctrl-C" if isinstance(viewer, WebViewer) else ""
    sys.stdout.write(f"{path}{where}\n")
    sys.stdout.flush()
    try:
        done = subprocess.run([*viewer.command(), str(path)], check=False)
    except KeyboardInterrupt:
        return
    sys.exit(done.returncode)


if __name__ == "__main__":
    main()
