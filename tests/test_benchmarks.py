"""The benchmarks run, on one small problem."""

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_flows_are_timed_and_tabulated(tmp_path: Path) -> None:
    script = ROOT / "experiments" / "benchmarks" / "flows.py"
    subprocess.run([sys.executable, script, "--quick", "--output", tmp_path], check=True)
    (row,) = json.loads((tmp_path / "flows.json").read_text())["rows"]
    assert row["exact"]["backward"] > row["exact"]["sample"] > 0
    ratio = row["exact"]["sample"] / row["TanhNormal"]["sample"]
    assert f"{ratio:.2f}" in (tmp_path / "flows.md").read_text()
