"""Agents that know no constraints act within them, and break them without the wrapper."""

import re
from collections.abc import Callable

import pytest

from tests.examples.conftest import Optimized
from tests.examples.scripts import run

Run = Callable[..., str]


def violations(printed: str) -> list[int]:
    return [int(count) for count in re.findall(r": (\d+) violations in \d+ steps", printed)]


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_stable_baselines(algorithm: str) -> None:
    pytest.importorskip("stable_baselines3", reason="of the extra 'bench'")
    steps = {"ppo": 256, "sac": 140}[algorithm]
    safe = run("stable_baselines", "--algorithm", algorithm, "--steps", steps)
    assert violations(safe) == [0, 0]
    assert f"in {steps} steps" in safe
    unsafe = run("stable_baselines", "--algorithm", algorithm, "--steps", steps, "--unsafe")
    assert sum(violations(unsafe)) > 10


def test_single_file_ppo(optimized: Optimized) -> None:
    arguments = ("--steps", 480, "--agents", 4, "--length", 60)
    assert violations(run("single_file_ppo", *arguments)) == [0, 0]
    optimized.assert_all_learned()
    assert sum(violations(run("single_file_ppo", *arguments, "--unsafe"))) > 10
