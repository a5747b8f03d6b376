"""What a command says when the packages it needs are not installed."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def needs_extra(name: str) -> Iterator[None]:
    """Import packages of an extra, or end the command with a sentence that says what to install.

    Args:
        name: the extra of this package that brings them.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if str(error.name).startswith(__package__.partition(".")[0]):
            raise
        sys.exit(
            f"{error.name} is not installed; install it with: pip install 'cnfp_torchrl[{name}]'"
        )
