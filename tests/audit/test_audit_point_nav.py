"""The audit of point navigation: the shipped geometry passes, wrong ones are caught."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import Compose, TransformedEnv

from cnfp_torchrl.audit import AuditReport, AuditSettings, audit
from cnfp_torchrl.commands.audit import FLAWS_FOUND, audit_configured
from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.envs import ConstraintAnchor, GeometryTransform, constraint_bijectors
from cnfp_torchrl.geometry import Ball, Box
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, Layout, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.training.run_folder import BEST
from cnfp_torchrl.visual.figures.audit import audit_figure, save_audit
from tests.entry_points import call_command
from tests.training.conftest import TinyRun

ORDER = ["battery", "obstacle"]
QUICK = ["batch=256", "audit.states=32", "audit.actions=16", "audit.steps=20"]


def audited(
    battery: GeometryTransform, obstacle: GeometryTransform, low: bool = False, **settings: Any
) -> AuditReport:
    """Audit these geometries; with `low`, from starts at which the battery is nearly empty."""
    layout = Layout(battery_start=(21, 30)) if low else Layout()
    env = TransformedEnv(PointNavEnv([256], layout=layout), Compose(battery, obstacle))
    env.append_transform(ConstraintAnchor(constraint_bijectors(env), ORDER))
    given = {"states": 64, "actions": 32, "steps": 12, "uniform": False} | settings
    return audit(env, order=ORDER, settings=AuditSettings(**given))


def found(report: AuditReport, source: str, name: str, kind: str) -> Any:
    return report.as_dict()["sources"][source][name][kind]


def test_the_shipped_geometry_passes() -> None:
    report = audit_configured(compose_config(*QUICK, name="audit"))
    assert report.flaws == []
    assert list(report.sources) == ["rollouts", "uniform"]
    for source in report.sources:
        for name in (*ORDER, "together"):
            for kind in ("unsound", "escaped", "dead_ends"):
                assert found(report, source, name, kind)["count"] == 0
                assert found(report, source, name, kind)["of"] > 100
    assert report.executed.violations == {"obstacle": 0, "battery": 0}
    assert report.executed.steps == 256 * 20
    rows = [
        line for line in str(report).split("\n") if line.startswith(("states", *report.sources))
    ]
    # Three tables for two sources and three names, then the flow's for each source.
    assert len(rows) == 3 * (1 + 2 * 3) + 2
    assert max(map(len, rows)) <= 100
    # Uniform states lie in the rectangle, too, and with batteries below the threshold.
    assert found(report, "uniform", "obstacle", "relaxed")["count"] > 0
    assert found(report, "uniform", "battery", "relaxed")["count"] > 0
    assert found(report, "rollouts", "together", "gave_way")["count"] == 0
    assert found(report, "rollouts", "obstacle", "coverage")["share"] > 0.9
    assert "no flaw found" in str(report)


class WrongSign(ObstacleGeometry):
    """Bounds a margin beyond walls and edges, where they should keep it."""

    def constraint_set(self, tensordict: TensorDictBase) -> Box:
        box = super().constraint_set(tensordict)
        beyond = 2 * 1e-4 / self.layout.step_length
        return Box(
            torch.where(box.low > -1, box.low - beyond, box.low),
            torch.where(box.high < 1, box.high + beyond, box.high),
            validate_args=False,
        )


class WallsOnly(ObstacleGeometry):
    """A box that ignores the rectangle."""

    def constraint_set(self, tensordict: TensorDictBase) -> Box:
        position = tensordict["observation"][..., :2]
        low, high = (-1 - position) / 0.1, (1 - position) / 0.1
        return Box(low.clamp(-1, 0.9), high.clamp(-0.9, 1), validate_args=False)


class LargeBall(BatteryGeometry):
    """A ball with two action units more than the battery reaches."""

    def constraint_set(self, tensordict: TensorDictBase) -> Ball:
        ball = super().constraint_set(tensordict)
        return Ball(ball.center, ball.radius + 2, validate_args=False)


@pytest.mark.parametrize(
    ("battery", "obstacle", "guilty"),
    [
        (BatteryGeometry, WrongSign, "obstacle"),
        (BatteryGeometry, WallsOnly, "obstacle"),
        (LargeBall, ObstacleGeometry, "battery"),
    ],
)
def test_wrong_geometry_is_caught_with_its_state(
    battery: type[BatteryGeometry], obstacle: type[ObstacleGeometry], guilty: str
) -> None:
    report = audited(battery(), obstacle(), low=guilty == "battery")
    assert report.flaws
    assert all(flaw.startswith(guilty) for flaw in report.flaws)
    assert found(report, "rollouts", guilty, "unsound")["count"] > 0
    (example, *_) = found(report, "rollouts", guilty, "examples")["unsound"]
    # The state, the action and nothing else: the environment agrees that it violates.
    x, y, charge, *goal = example["state"]["observation"]
    env = PointNavEnv()
    env.reset(position=[x, y], battery=round(100 * charge), goal=goal)
    judged = env.step(env.rand_action().set("action", torch.tensor(example["action"])))
    violated = dict(zip(env.constraint_names, judged["next", "cost"].tolist(), strict=True))
    assert violated[guilty] == 1
    assert example["violates"] == [name for name, cost in violated.items() if cost]
    assert f"{guilty}, rollouts, worst of unsound" in str(report)
    (scene,) = (state for state in report.worst_states if state.name == guilty)
    assert "violate" in scene.reason
    assert bool((scene.inside & scene.violates).any())


def test_optimistic_plans_lead_to_dead_ends() -> None:
    # One step never tells: the indicator does not depend on the action. The rollouts do.
    report = audited(
        BatteryGeometry(Layout(zone_radius=0.6)), ObstacleGeometry(), low=True, states=128
    )
    assert found(report, "rollouts", "battery", "unsound")["count"] == 0
    assert found(report, "rollouts", "battery", "dead_ends")["count"] > 0
    assert report.executed.led_into["battery"] > 0
    assert any("led into" in flaw for flaw in report.flaws)
    (example, *_) = report.executed.examples["battery"]
    assert example["steps_until_violation"] >= 1
    assert example["sets"]["battery"]["active"]
    assert audited(BatteryGeometry(), ObstacleGeometry(), strict=True).flaws == []


def test_the_figure_shows_the_worst_states(tmp_path: Path) -> None:
    report = audited(BatteryGeometry(), WallsOnly(), states=16, actions=8)
    assert [scene.name for scene in report.worst_states] == ORDER
    text = [t.get_text() for t in audit_figure(report).findobj() if hasattr(t, "get_text")]
    assert any("in the set violate" in value for value in text)
    path = save_audit(report, tmp_path / "audit.png")
    assert path.read_bytes().startswith(b"\x89PNG")
    assert path.stat().st_size > 20_000


def test_a_trained_run_is_audited(tiny_run: TinyRun) -> None:
    folder, _ = tiny_run("flow=radial", "env.order=[obstacle,battery]")
    report = audit_configured(compose_config(*QUICK, f"run={folder.path}", name="audit"))
    assert report.order == ("obstacle", "battery")
    assert report.subject["flow"] == "RadialFlow"
    assert report.subject["policy"] == "actor"
    assert report.flaws == []
    (folder.path / BEST).unlink(missing_ok=True)
    of_best = compose_config(f"run={folder.path}", f"checkpoint={BEST}", name="audit")
    with pytest.raises(FileNotFoundError, match=f"checkpoint: expected {BEST} in"):
        audit_configured(of_best)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("audit.states=0", "audit.states: expected a whole number >= 1, given 0"),
        ("audit.states=many", "audit.states: expected a whole number >= 1, given 'many'"),
        ("audit.seed=abc", "audit.seed: expected a whole number >= 0, given 'abc'"),
        ("audit.strict=maybe", "audit.strict: expected true or false, given 'maybe'"),
        ("batch=0", "batch: expected a whole number >= 1, given 0"),
        ("batch=many", "batch: expected a whole number >= 1, given 'many'"),
        ("env.order=battery", "env.order: expected a list"),
        ("run=absent", "lacks"),
    ],
)
def test_wrong_settings_are_explained(override: str, message: str) -> None:
    with pytest.raises(Exception, match=message):
        audit_configured(compose_config(override, name="audit"))


def test_an_unknown_environment_is_explained() -> None:
    with pytest.raises(Exception, match=r"(?s)nonsense.*point_nav"):
        compose_config("env=nonsense", name="audit")


def test_the_command_exits_with_3_where_a_chain_of_squashes_escapes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    low = "+env.layout.battery_start=[21,30]"
    assert call_command("cnfp-audit", "flow=squash", low, *QUICK) == FLAWS_FOUND
    assert "FLAW: battery" in capsys.readouterr().out
    (folder,) = tmp_path.glob("outputs/audits/*/*/")
    assert {path.name for path in folder.iterdir()} >= {"audit.json", "audit.png"}
    assert json.loads((folder / "audit.json").read_text())["flaws"]
