import itertools
import json
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.errors import ConfigCompositionException

from cnfp_torchrl.configuration import compose_config, config_directory
from cnfp_torchrl.tasks.point_nav import PointNavEnv
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.train import train

from .conftest import TINY, TinyRun


def form(value: Any) -> Any:
    """Return the keys and types of a nested result."""
    if isinstance(value, dict):
        return {key: form(entry) for key, entry in value.items()}
    return type(value).__name__


def told(summary: dict[str, Any]) -> dict[str, Any]:
    """Return a summary without what flows that guarantee nothing cannot tell."""
    kept = {key: value for key, value in summary.items() if key != "constraints"}
    return {key: told(entry) if isinstance(entry, dict) else entry for key, entry in kept.items()}


ENTROPIES = [
    *itertools.product(
        ["exact", "gauge", "radial", "squash", "unconstrained"], ["reference", "action"]
    ),
    ("projection", "reference"),
]
RUNS = {
    f"{flow}, {entropy} entropy": [f"flow={flow}", f"loss.entropy={entropy}"]
    for flow, entropy in ENTROPIES
} | {
    path.stem: [f"experiment={path.stem}"] for path in config_directory().glob("experiment/*.yaml")
}


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The summary of a run of the default configuration."""
    folder = RunFolder.create(tmp_path_factory.mktemp("runs") / "reference")
    return train(compose_config(*TINY), folder)


@pytest.mark.parametrize("name", RUNS)
def test_every_flow_and_experiment_trains_and_reports_in_one_form(
    name: str, reference: dict[str, Any], tiny_run: TinyRun
) -> None:
    folder, summary = tiny_run(*RUNS[name])
    assert form(told(summary)) == form(told(reference))
    assert json.loads((folder.path / "summary.json").read_text()) == summary
    assert summary["steps"] == 192
    assert list(summary["violations"]) == ["obstacle", "battery"]
    is_safe = name.startswith(("exact", "gauge", "radial", "projection"))
    if is_safe:
        assert summary["violations"] == {"obstacle": 0, "battery": 0}
    elif not name.startswith("squash"):
        assert sum(summary["violations"].values()) > 0
    # Whether a constraint holds is told where the flow needs to know.
    evaluated = summary["evaluation"]["stochastic"]["steps"]
    for name, counts in summary["constraints"].items():
        assert sum(counts["steps"].values()) == 192 + 2 * evaluated
        assert counts["violations_while"]["active"] == 0, name
    assert sorted(summary["constraints"]) == (["battery", "obstacle"] if is_safe else [])


def test_violations_are_those_the_environment_counts(
    tiny_run: TinyRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    # An unconstrained agent in a small arena breaks rules at once; count them beside the trainer.
    counted = torch.zeros(2)
    step = PointNavEnv._step

    def counting_step(self: PointNavEnv, tensordict: Any) -> Any:
        result = step(self, tensordict)
        counted.add_(result["cost"].reshape(-1, 2).sum(0))
        return result

    monkeypatch.setattr(PointNavEnv, "_step", counting_step)
    _, summary = tiny_run("flow=unconstrained")
    obstacle, battery = counted.tolist()
    assert summary["violations"] == {"obstacle": obstacle, "battery": battery}
    assert summary["violations"]["obstacle"] > 0


def test_the_order_is_that_of_the_environments_geometry(tiny_run: TinyRun) -> None:
    assert tiny_run()[1]["order"] == ["battery", "obstacle"]
    assert tiny_run("~env.geometry.battery")[1]["order"] == ["obstacle"]
    assert tiny_run("env.order=[obstacle,battery]")[1]["order"] == ["obstacle", "battery"]


def test_training_changes_actor_critic_and_temperature(tiny_run: TinyRun) -> None:
    states = [
        tiny_run(f"training.update_ratio={ratio}")[0].load_checkpoint()["loss"]
        for ratio in (0.0, 0.1)
    ]
    for part in ("actor_network_params", "qvalue_network_params", "log_alpha"):
        names = [name for name in states[0] if name.startswith(part) and states[0][name].numel()]
        floating = [name for name in names if states[0][name].is_floating_point()]
        assert floating
        assert any(not torch.equal(states[0][name], states[1][name]) for name in floating), part


def test_the_same_seed_gives_the_same_run(tiny_run: TinyRun) -> None:
    first, second, other = (tiny_run(f"seed={seed}")[1]["return_mean"] for seed in (3, 3, 4))
    assert first == second
    assert first != other


def test_metrics_reach_every_logger(tiny_run: TinyRun) -> None:
    folder, _ = tiny_run("logger=csv_tensorboard", "env.base.max_steps=4")
    scalars = folder.path / "metrics" / "scalars"
    expected = ["train/return", "violations/obstacle", "violations/battery", "loss/qvalue"]
    for name in expected:
        rows = (scalars / f"{name}.csv").read_text().splitlines()
        assert rows
        step, value = rows[-1].split(",")
        assert int(step) == 192
        assert torch.isfinite(torch.tensor(float(value)))
    assert list((folder.path / "tensorboard").glob("events.out.tfevents*"))


def test_no_logger_is_fine(tiny_run: TinyRun) -> None:
    folder, _ = tiny_run("logger=none")
    assert {path.name for path in folder.path.iterdir()} == {
        "config.yaml",
        "checkpoint.pt",
        "best.pt",
        "checkpoints",
        "summary.json",
    }


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("env.order=[battery]", r"order: expected each of the constraints .* given \['battery'\]"),
        ("env.order=[battery,obstacle,wind]", "wind"),
        ("loss.entropy=maximal", "'reference' or 'action', given 'maximal'"),
        ("env.base.collision=bounce", "bounce"),
        ("env.layout.stations=[]", "stations"),
        ("env.geometry.battery.name=charge", "env.geometry.battery.name: expected 'battery'"),
        ("env.geometry.battery=null", "env.geometry.battery: expected a _target_, given null"),
        (
            "env.geometry=null env.order=[]",
            "env.geometry: expected at least one constraint for E",
        ),
    ],
)
def test_bad_configuration_is_refused_before_anything_runs(
    override: str,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def no_step(*_: Any) -> None:
        raise AssertionError("the environment was stepped")

    monkeypatch.setattr(PointNavEnv, "_step", no_step)
    folder = RunFolder.create(tmp_path / "run")
    with pytest.raises(Exception, match=message):
        train(compose_config(*override.split()), folder)
    assert not list(folder.path.iterdir())


@pytest.mark.parametrize(
    "override", ["flow=perfect", "env/obstacle=visble", "env.oder=[battery]", "sed=1"]
)
def test_unknown_configuration_is_refused(override: str) -> None:
    with pytest.raises(ConfigCompositionException):
        compose_config(override)


def test_a_diverged_run_fails_loudly(tiny_run: TinyRun) -> None:
    with pytest.raises((FloatingPointError, ValueError), match=r"nan|inf"):
        tiny_run("optim.lr=1e30", "training.update_ratio=1")
