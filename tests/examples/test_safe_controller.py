"""The corrected controller: safe before and after training, and better after it."""

import re

from tests.examples.scripts import run


def test_safe_and_better() -> None:
    printed = run("safe_controller", "--steps", 5)
    left = [float(number) for number in re.findall(r"(\S+) left to the goal, 0 positions", printed)]
    assert len(left) == 2
    assert left[1] < left[0] - 0.5
