from pathlib import Path

import pytest

from experiments.resume import killed_runs


@pytest.mark.slow
def test_runs_killed_at_random_moments_end_as_one_that_was_not(tmp_path: Path) -> None:
    rows = list(killed_runs(tmp_path, kills=20, steps=1600, seed=1))
    assert rows
    assert [row[2] for row in rows] == ["nothing"] * len(rows)
