"""Records made up for tests, of the form that real runs have."""

from __future__ import annotations

import numpy as np

from experiments.paper.records import Outcome, Record, Series

CONSTRAINTS = ("obstacle", "battery")
METHODS: dict[str, tuple[float, float]] = {
    "exact": (1.03, 0.0),
    "exact_action_entropy": (0.99, 0.0),
    "squash": (1.0, 0.001),
    "unconstrained": (1.24, 0.5),
    "penalty": (0.6, 0.05),
    "lagrangian": (0.7, 0.1),
    "projection": (0.95, 0.0),
}
"""Final score and violations a step at the end of training, for each method."""


def make_outcome(
    score: float = 1.0, violations: int = 0, *, episodes: int = 400, error: float = 0.5
) -> Outcome:
    return Outcome(
        return_mean=118 * score - 104,
        return_standard_error=error,
        score=score,
        violations=dict.fromkeys(CONSTRAINTS, violations),
        episodes=episodes,
        steps=100 * episodes,
    )


def make_record(
    method: str = "exact",
    seed: int = 0,
    *,
    steps: int = 20_000,
    interval: int = 500,
    score: float = 1.0,
    rate: float = 0.0,
) -> Record:
    """Return a record whose score rises to `score` and which violates less and less, to `rate`."""
    generator = np.random.default_rng([seed, len(method)])
    at = np.arange(interval, steps + 1, interval)
    level = score * (1 - np.exp(-5 * at / steps)) + generator.normal(0, 0.02, len(at))
    returns = 118 * level - 104
    rates = rate * (1 + 9 * np.exp(-5 * at / steps))
    total = np.cumsum(generator.poisson(rates * interval))
    moments = at / 120.0 * generator.uniform(0.9, 1.1)
    grid = tuple(at.tolist())
    curves = {
        "train/return": Series(grid, tuple(returns.tolist())),
        "train/seconds": Series(grid, tuple(moments.tolist())),
        "train/processor_seconds": Series(grid, tuple((0.8 * moments).tolist())),
        "train/alpha": Series(grid, tuple(np.exp(-3 * at / steps).tolist())),
    }
    for name in CONSTRAINTS:
        curves[f"violations/{name}"] = Series(grid, tuple(total.astype(float).tolist()))
    count = int(total[-1])
    final = float(score + generator.normal(0, 0.01))
    left = round(rate * 40_000)
    both = {
        "stochastic": make_outcome(final, left),
        "deterministic": make_outcome(final + 0.02, left),
    }
    after = {
        "stochastic": make_outcome(final - 0.05, 2 * left),
        "deterministic": make_outcome(final - 0.04, 2 * left),
    }
    return Record(
        method=method,
        seed=seed,
        overrides=(f"collector.total_frames={steps}",),
        config={
            "seed": seed,
            "collector": {"total_frames": steps},
            "env": {"agents": 16, "score": {"zero": -104.0, "one": 14.0}},
        },
        versions={"python": "3.12.0", "torch": "2.13.0"},
        commit=None,
        steps=steps,
        seconds=float(moments[-1] + 5),
        curves=curves,
        training_violations=dict.fromkeys(CONSTRAINTS, count),
        evaluation=both,
        afterwards={"second rectangle": after, "battery reserve 30 %": after},
    )


def make_records(seeds: int = 3, *, steps: int = 20_000) -> list[Record]:
    """Return a record for each of `METHODS` and each seed."""
    return [
        make_record(method, seed, steps=steps, score=score, rate=rate)
        for method, (score, rate) in METHODS.items()
        for seed in range(seeds)
    ]
