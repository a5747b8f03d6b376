"""What a stranger's file could carry: code that runs when it is unpickled."""

from pathlib import Path


class Payload:
    """Makes a file when it is unpickled, whose being there tells that code has run."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return Path.touch, (self.path,)
