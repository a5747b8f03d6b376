"""The distribution alone: its own numbers agree with each other."""

import re

import pytest

from tests.examples.scripts import run


def test_contained_and_normalized() -> None:
    printed = run("distribution_alone", "--samples", 20000, "--grid", 1000)
    assert "0 of 20000 samples outside" in printed
    (total,) = re.findall(r"integrates to (\S+)", printed)
    assert float(total) == pytest.approx(1, abs=2e-3)
    ((integral, sampled),) = re.findall(r"entropy (\S+) by integration, (\S+) by sampling", printed)
    assert float(integral) == pytest.approx(float(sampled), abs=0.03)
