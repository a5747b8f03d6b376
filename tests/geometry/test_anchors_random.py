"""Anchors of random intersections against SciPy; `experiments/benchmarks/anchors.py` runs more."""

from __future__ import annotations

import pytest

from experiments.benchmarks.anchors import Comparison, compare


def check(results: list[Comparison]) -> None:
    """Check the amounts against the least ones, and the anchors' room."""
    amounts = [amount for result in results for amount in result.amounts]
    certain = [amount for amount in amounts if amount.certain]
    assert [amount for amount in certain if amount.error > 1] == []
    assert min(result.share for result in results) >= 0.3
    # The cases are worth something, and so is SciPy.
    assert len(certain) > 0.95 * len(amounts)
    relaxed = sum(amount.given > 0 for amount in certain)
    assert 0.1 * len(amounts) < relaxed < 0.9 * len(amounts)
    assert {1, 2, 6} <= {amount.dim for amount in certain}
    assert any(0 < amount.given < 1e-2 for amount in certain)


def test_random_intersections() -> None:
    check(compare(100, seed=2))


@pytest.mark.slow
def test_thousands_of_random_intersections() -> None:
    check(compare(2000, seed=3))
