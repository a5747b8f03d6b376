"""Anchors of random intersections against SciPy; `experiments/benchmarks/anchors.py` runs more."""

from __future__ import annotations

from experiments.benchmarks.anchors import compare


def test_random_intersections() -> None:
    results = compare(500, seed=2)
    feasible = [result for result in results if result.feasible]
    assert [result for result in results if not result.decided_rightly] == []
    assert [result for result in results if not result.deep_enough] == []
    # The cases are worth something: all dimensions, empty and tight intersections among them.
    assert {1, 2, 32} <= {result.dim for result in results}
    assert 50 < len(feasible) < 450
    assert sum(result.best < 1e-2 for result in feasible) > 50
