"""Records made up for tests, of the form that real runs have."""

from __future__ import annotations

from typing import Any

import numpy as np

from experiments.paper.records import Evaluation, HostileRun, Outcome, Record, Series

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


def changed(record: Record, **fields: Any) -> Record:
    """Return the record with other fields, unchecked."""
    return record.model_copy(update=fields)


def make_outcome(score: float = 1.0, violations: int = 0) -> Outcome:
    return Outcome(
        return_mean=118 * score - 104,
        return_standard_error=0.5,
        score=score,
        violations=dict.fromkeys(CONSTRAINTS, violations),
        episodes=400,
        steps=40_000,
    )


def make_evaluation(score: float = 1.0, violations: int = 0) -> Evaluation:
    return Evaluation(
        stochastic=make_outcome(score, violations),
        deterministic=make_outcome(score + 0.02, violations),
    )


def make_record(
    method: str = "exact",
    seed: int = 0,
    *,
    steps: int = 20_000,
    score: float = 1.0,
    rate: float = 0.0,
) -> Record:
    """Return a record whose score rises to `score` and which violates less and less, to `rate`."""
    generator = np.random.default_rng([seed, len(method)])
    at = np.arange(500, steps + 1, 500)
    level = score * (1 - np.exp(-5 * at / steps)) + generator.normal(0, 0.02, len(at))
    rates = rate * (1 + 9 * np.exp(-5 * at / steps))
    total = np.cumsum(generator.poisson(rates * 500)).astype(float)
    moments = at / 120.0 * generator.uniform(0.9, 1.1)
    curves = {
        "train/return": 118 * level - 104,
        "train/processor_seconds": 0.8 * moments,
        "train/alpha": np.exp(-3 * at / steps),
        **dict.fromkeys((f"violations/{name}" for name in CONSTRAINTS), total),
    }
    final, left = float(score + generator.normal(0, 0.01)), round(rate * 40_000)
    after = make_evaluation(final - 0.05, 2 * left)
    return Record(
        method=method,
        seed=seed,
        overrides=(),
        config={
            "seed": seed,
            "collector": {"total_frames": steps},
            "env": {"agents": 16, "score": {"zero": -104.0, "one": 14.0}},
        },
        versions={"python": "3.12.0", "torch": "2.13.0"},
        commit=None,
        steps=steps,
        seconds=float(moments[-1] + 5),
        curves={
            name: Series(steps=tuple(at.tolist()), values=tuple(values.tolist()))
            for name, values in curves.items()
        },
        training_violations=dict.fromkeys(CONSTRAINTS, int(total[-1])),
        evaluation=make_evaluation(final, left),
        afterwards={"second rectangle": after, "battery reserve 30 %": after},
    )


def make_runs(seeds: int = 3, *, steps: int = 20_000) -> dict[str, list[Record]]:
    """Return a record for each of `METHODS` and each seed."""
    return {
        method: [
            make_record(method, seed, steps=steps, score=score, rate=rate) for seed in range(seeds)
        ]
        for method, (score, rate) in METHODS.items()
    }


def hostile_run(flow: str, violations: int = 0) -> HostileRun:
    return HostileRun(
        flow=flow, network="calm", steps=1000, violations={"obstacle": 0, "battery": violations}
    )
