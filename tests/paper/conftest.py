"""Fixtures of the trainer's and of the pictures' tests, and reports that are quick to draw."""

import pytest

from experiments.paper import statistics
from tests.training.conftest import tiny_run

__all__ = ["tiny_run"]


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw and resample less than a report does."""
    monkeypatch.setattr(statistics, "RESAMPLES", 200)
