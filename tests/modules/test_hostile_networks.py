"""No network breaks a constraint behind a safe flow: a small run, and the kept result of a large.

The large one is `experiments/hostile_networks.py`.
"""

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
from _pytest.mark.structures import ParameterSet

EXPERIMENT = Path(__file__).parents[2] / "experiments" / "hostile_networks.py"


def load() -> ModuleType:
    spec = importlib.util.spec_from_file_location("hostile_networks", EXPERIMENT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


experiment = load()


def pairs() -> list[ParameterSet]:
    """Return all flows with all networks, a third of them fast: each flow, and each network."""
    return [
        pytest.param(flow, name, marks=() if (i + j) % 3 == 0 else pytest.mark.slow)
        for i, flow in enumerate(experiment.SAFE_FLOWS)
        for j, name in enumerate(experiment.NETWORKS)
    ]


@pytest.mark.parametrize(("flow", "name"), pairs())
def test_no_violations_at_all(flow: str, name: str) -> None:
    hostile = experiment.NETWORKS[name]
    row = experiment.run(flow, name, hostile, steps=20_000, agents=500, seed=1)
    assert row.steps == 20_000
    assert row.violations == {"obstacle": 0, "battery": 0}
    assert row.drops == {"obstacle": 0, "battery": 0}
    assert row.minimum_anchor_slack >= 0.025


def test_without_constraints_the_same_count_is_not_zero() -> None:
    hostile = experiment.NETWORKS["0, scale 1e4"]
    row = experiment.run("unconstrained", "", hostile, steps=2_000, agents=50, seed=1)
    assert all(count > 100 for count in row.violations.values())
    assert all(count > 100 for count in row.drops.values())


@pytest.mark.parametrize("name", [name for name, change in experiment.NETWORKS.items() if change])
def test_networks_are_as_hostile_as_their_names(name: str) -> None:
    hostile = experiment.NETWORKS[name]
    network = experiment.HostileNetwork(hostile)
    observation = 2 * torch.rand(1000, 5) - 1
    first, scale = network(observation)
    again, _ = network(observation)
    assert (scale == hostile.scale).all()
    assert f"scale {hostile.scale:.0e}".replace("+0", "").replace("-0", "-") in name
    magnitude = 0.0 if name.startswith("0,") else 1e6
    assert first.abs().max() == pytest.approx(magnitude, rel=0.1)
    if "per episode" in name:
        assert torch.equal(first, again)
        network.new_episode()
        assert not torch.equal(first, network(observation)[0])
    elif "per step" in name:
        assert not torch.equal(first, again)


def test_the_command_writes_both_files_and_fails_on_violations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "results" / "hostile.json"
    options = ["--steps", "400", "--agents", "200", "--output", str(output)]
    monkeypatch.setattr(sys, "argv", ["hostile_networks.py", *options])
    monkeypatch.setattr(experiment, "NETWORKS", {"untrained, default": None})
    experiment.main()
    kept = json.loads(output.read_text())
    assert [row["flow"] for row in kept["rows"]] == list(experiment.FLOWS)
    assert kept["versions"]["torch"] == torch.__version__
    assert "--steps 400 --agents 200 --seed 0" in kept["command"]
    rows = output.with_suffix(".md").read_text().count("| untrained, default | 400 | 0 | 0 |")
    assert rows >= len(experiment.SAFE_FLOWS)

    monkeypatch.setattr(experiment, "FLOWS", ("unconstrained",))
    monkeypatch.setattr(experiment, "SAFE_FLOWS", ("unconstrained",))
    with pytest.raises(SystemExit, match="violations, of which there should be none"):
        experiment.main()
    assert json.loads(output.read_text())["rows"][0]["violations"]["obstacle"] > 0


def test_the_kept_result_is_of_these_networks() -> None:
    kept = json.loads(experiment.RESULT.read_text())
    cases = [(flow, name) for flow in experiment.FLOWS for name in experiment.NETWORKS]
    assert [(row["flow"], row["network"]) for row in kept["rows"]] == cases
    for row in kept["rows"]:
        assert row["steps"] >= 1_000_000
        if row["flow"] in experiment.SAFE_FLOWS:
            assert row["violations"] == {"obstacle": 0, "battery": 0}
    assert experiment.RESULT.with_suffix(".md").read_text() == experiment.as_markdown(kept)
