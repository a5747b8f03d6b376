"""Files that are written whole or not at all."""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

_PARTIAL = ".{}.{}.partial"


@contextmanager
def whole_file(path: Path, *, exclusive: bool = False) -> Iterator[BinaryIO]:
    """Open a file that takes its name only once everything is on the disk.

    It is written under another name in the same folder. After an error, a full disk or a power cut,
    the file that had the name before is still there, or none.

    Args:
        path: The file's final name.
        exclusive: Whether to refuse to replace another file, even one made in the meantime.

    Raises:
        FileExistsError: when exclusive and there is a file of this name.
    """
    partial = path.with_name(_PARTIAL.format(path.name, secrets.token_hex(4)))
    try:
        with partial.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if exclusive:
            # Unlike renaming, linking never replaces: of two processes one succeeds.
            os.link(partial, path)
        else:
            partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def remove_partial_files(path: Path) -> None:
    """Remove what processes have left that were killed while they wrote a file.

    Args:
        path: The file's final name, or a pattern for several of one folder; nobody may be writing.
    """
    for partial in path.parent.glob(_PARTIAL.format(path.name, "?" * 8)):
        partial.unlink(missing_ok=True)


def write_json(path: Path, document: Any) -> None:
    """Write plain values as JSON, whole or not at all.

    Raises:
        ValueError: for infinity and NaN, which JSON cannot express.
    """
    with whole_file(path) as file:
        file.write(f"{json.dumps(document, indent=2, allow_nan=False)}\n".encode())
