"""The benchmarks run, on one small problem."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "experiments" / "benchmarks"


def run(name: str, *arguments: object) -> None:
    """Run a benchmark on little."""
    script = str(FOLDER / f"{name}.py")
    subprocess.run([sys.executable, script, "--quick", *map(str, arguments)], check=True)


def test_flows_are_timed_and_tabulated(tmp_path: Path) -> None:
    run("flows", "--output", tmp_path)
    (row,) = json.loads((tmp_path / "flows.json").read_text())["rows"]
    assert row["exact"]["sample"]["ms"] > 0
    assert row["TanhNormal"]["sample"]["ratio"] == 1
    assert f"{row['exact']['sample']['ratio']:.2f}" in (tmp_path / "flows.md").read_text()


def test_distortion_is_measured_and_tabulated(tmp_path: Path) -> None:
    run("distortion", "--output", tmp_path)
    rows = {row["flow"]: row for row in json.loads((tmp_path / "distortion.json").read_text())}
    assert rows["soft, p = 2"]["moved"]["max"] < rows["exact (hard)"]["moved"]["max"]
    assert rows["projection"]["on_boundary"]["share"] > 0.1
    text = (tmp_path / "distortion.md").read_text()
    assert all(f"| {name} |" in text for name in rows)


def test_the_stream_is_timed_and_tabulated(tmp_path: Path) -> None:
    run("stream", "--output", tmp_path)
    document = json.loads((tmp_path / "stream.json").read_text())
    assert document["setting"]["imported_when_off"] == "False"
    text = (tmp_path / "stream.md").read_text()
    for name, row in document["rows"].items():
        (milliseconds,) = row["ms"]
        assert f"| {name} | {milliseconds:.2f} |" in text


def test_updates_and_training_are_timed_and_tabulated(tmp_path: Path) -> None:
    run("updates", "--output", tmp_path)
    document = json.loads((tmp_path / "updates.json").read_text())
    assert "stable-baselines3" in document["about"]
    text = (tmp_path / "updates.md").read_text()
    update, training = document["results"].values()
    assert set(training["rows"]) < set(update["rows"])
    for row in (*update["rows"].values(), *training["rows"].values()):
        assert 0 < row["low"] <= row["ratio"] <= row["high"]
        assert f"| {row['ratio']:.2f} |" in text
    assert update["rows"]["Stable-Baselines3"]["ratio"] == 1


@pytest.mark.slow
def test_layers_are_timed_and_judged(tmp_path: Path) -> None:
    run("layers", "--skip", "qpax", "pinet", "--output", tmp_path)
    document = json.loads((tmp_path / "layers.json").read_text())
    assert "qpax" in document["about"]["not measured"]
    for rows in document["results"].values():
        assert rows["exact"]["ratio"] == 1
        for name in ("exact", "gauge", "soft", "soft, anchor searched", "SRad, dense Jacobian"):
            assert rows[name]["broken, %"] == 0
            assert rows[name]["ms, both"] > 0
    rows = document["results"]["Eight rows in six dimensions, 4 states"]
    assert rows["Dykstra, 50 rounds"]["broken, %"] > 0


def test_what_is_measured_on_a_gpu_is_tabulated(tmp_path: Path) -> None:
    run("gpu", "--device", "cpu", "--out", tmp_path)
    document = json.loads((tmp_path / "gpu.json").read_text())
    assert not [key for key in document["about"] if key.endswith("failed")]
    text = (tmp_path / "gpu.md").read_text()
    assert all(f"## {title}" in text for title in document["results"])


def test_anchors_are_timed_and_tabulated(tmp_path: Path) -> None:
    run("anchor_times", "--out", tmp_path)
    results = json.loads((tmp_path / "anchors.json").read_text())["results"]
    text = (tmp_path / "anchors.md").read_text()
    assert len(results) == 2
    for title, rows in results.items():
        assert f"## {title}" in text
        assert {"exact flow", "anchors, 1 % relaxed", "anchors, 10 % relaxed"} < set(rows)
        assert rows["exact flow"]["ratio"] == 1
        assert all(0 < row["low"] <= row["ratio"] <= row["high"] for row in rows.values())
    aims = text[text.index("## Aims, met and missed") :].splitlines()[4:]
    assert len(aims) == 3
    assert all(line.endswith("| met |") or "| missed by " in line for line in aims)


def test_each_line_is_measured_alone_and_tabulated(tmp_path: Path) -> None:
    lines = ["point-nav-step", "own-step", "tight-step", "whole-path", "flow"]
    run("lines", "--line", *lines, "--out", tmp_path)
    for line in lines:
        path = tmp_path / f"lines_{line.replace('-', '_')}.json"
        document = json.loads(path.read_text())
        assert {"torch", "torchrl", "tensordict"} <= set(document["about"])
        for title, rows in document["results"].items():
            assert f"## {title}" in path.with_suffix(".md").read_text()
            assert next(iter(rows.values()))["ratio"] == 1
            assert all(row["low"] <= row["ratio"] <= row["high"] for row in rows.values())
