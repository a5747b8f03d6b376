"""The error of a command whose packages are not installed."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def needs_extra(name: str) -> Iterator[None]:
    """End the command with the extra to install when an import in this context fails.

    Args:
        name: The extra of this package that brings the imported packages.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if str(error.name).startswith(__package__.partition(".")[0]):
            raise
        sys.exit(
            f"this command needs the extra {name!r}: pip install 'cnfp_torchrl[{name}]' "
            f"({error.name} is not installed)"
        )
