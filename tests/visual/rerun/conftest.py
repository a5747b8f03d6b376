"""Rerun as these tests want it."""

from collections.abc import Iterator

import pytest
import rerun as rr


@pytest.fixture(autouse=True)
def strict() -> Iterator[None]:
    """What Rerun would drop with a warning is an error."""
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)
