"""Files that are written whole or not at all."""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO


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
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
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


def write_json(path: Path, document: Any) -> None:
    """Write plain values as JSON, whole or not at all.

    Raises:
        ValueError: for infinity and NaN, which JSON cannot express.
    """
    with whole_file(path) as file:
        file.write(f"{json.dumps(document, indent=2, allow_nan=False)}\n".encode())
