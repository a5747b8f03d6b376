"""The learning examples on point navigation: they learn, and break no constraint."""

import ast
import re
import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tensordict import TensorDictBase

from cnfp_torchrl.envs import constrain_env
from cnfp_torchrl.objectives import ConstrainedPPOLoss
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from tests.examples.scripts import EXAMPLES, load, run

TINY: dict[str, tuple[object, ...]] = {
    "sac_made_safe": ("--steps", 512, "--agents", 16, "--updates", 2),
    "ppo_latent": ("--iterations", 2, "--agents", 16, "--horizon", 60, "--epochs", 1),
    "td3_latent_noise": ("--steps", 512, "--agents", 16, "--updates", 2),
}


class Executed:
    """Every executed step: position and charge before it, and the action, in float64."""

    def __init__(self) -> None:
        self.positions: list[np.ndarray] = []
        self.charges: list[np.ndarray] = []
        self.actions: list[np.ndarray] = []

    def violations(self) -> dict[str, int]:
        """Count by the definition of the task, with zero tolerance, and code of this file only."""
        old, action = np.concatenate(self.positions), np.concatenate(self.actions)
        new = old + 0.1 * action
        # The closed segment meets the closed rectangle where both slabs are entered before one is
        # left: Liang and Barsky.
        with np.errstate(divide="ignore", invalid="ignore"):
            times = np.stack([(-0.3 - old) / (new - old), (0.3 - old) / (new - old)])
        inside = np.abs(old) <= 0.3
        still = new == old
        enter = np.where(still, np.where(inside, -np.inf, np.inf), times.min(0)).max(-1)
        leave = np.where(still, np.where(inside, np.inf, -np.inf), times.max(0)).min(-1)
        crosses = np.maximum(enter, 0) <= np.minimum(leave, 1)
        obstacle = crosses | (np.abs(new) > 1).any(-1)
        battery = np.maximum(np.concatenate(self.charges) - 1, 0) < 20
        bounds = (np.abs(action) > 1).any(-1)
        counts = {"obstacle": obstacle, "battery": battery, "bounds": bounds}
        return {name: int(count.sum()) for name, count in counts.items()}


@pytest.fixture
def executed(monkeypatch: pytest.MonkeyPatch) -> Executed:
    seen = Executed()
    step = PointNavEnv._step

    def spy(self: PointNavEnv, tensordict: TensorDictBase) -> TensorDictBase:
        seen.positions.append(self.position.double().numpy())
        seen.charges.append(self.battery.numpy())
        seen.actions.append(tensordict["action"].double().numpy())
        return step(self, tensordict)

    monkeypatch.setattr(PointNavEnv, "_step", spy)
    return seen


@pytest.mark.parametrize("name", TINY)
def test_learns_and_breaks_nothing(name: str, executed: Executed, optimized: Any) -> None:
    printed = run(name, *TINY[name])
    steps = len(np.concatenate(executed.actions))
    assert steps >= 512
    assert f"obstacle: 0 violations in {steps} steps" in printed
    assert f"battery: 0 violations in {steps} steps" in printed
    assert executed.violations() == {"obstacle": 0, "battery": 0, "bounds": 0}
    optimized.assert_all_learned()


def test_without_the_line_it_breaks_constraints(executed: Executed) -> None:
    printed = run("sac_made_safe", "--steps", 2048, "--agents", 32, "--updates", 0, "--unsafe")
    counts = executed.violations()
    assert counts["obstacle"] > 50
    assert counts["battery"] > 50
    # The script counts what the environment says, and this file agrees with it.
    for name in ("obstacle", "battery"):
        assert f"{name}: {counts[name]} violations in 2048 steps" in printed


def test_the_marked_lines_are_all_that_makes_sac_safe(
    tmp_path: Path, executed: Executed, monkeypatch: pytest.MonkeyPatch
) -> None:
    safe = (EXAMPLES / "sac_made_safe.py").read_text().splitlines()
    plain = [line for line in safe if not line.endswith("  # safe")]
    marked = len(safe) - len(plain)
    assert 0 < marked <= 15
    assert f"made safe by {marked} lines" in (EXAMPLES / "README.md").read_text()
    script = tmp_path / "plain.py"
    script.write_text("\n".join(plain))
    names = {
        node.id for node in ast.walk(ast.parse(script.read_text())) if isinstance(node, ast.Name)
    }
    assert not [name for name in names if "constrain" in name.lower() or "safe" in name]
    monkeypatch.setattr(sys, "argv", ["plain.py", "--steps", "512", "--updates", "1"])
    runpy.run_path(str(script), run_name="__main__")
    assert len(np.concatenate(executed.actions)) == 512
    assert sum(executed.violations().values()) > 20


def test_the_sac_actor_itself_learns() -> None:
    script = load("sac_made_safe")
    env = constrain_env(PointNavEnv([8], seed=0), BatteryGeometry(), ObstacleGeometry())
    actor = script.make_actor(env)
    safe = script.constrain(actor, env)
    before = [parameter.detach().clone() for parameter in actor.parameters()]
    steps = script.train(env, safe, steps=128, updates=1)
    assert steps.shape == (128,)
    for parameter, first in zip(actor.parameters(), before, strict=True):
        assert bool((parameter != first).any())


def test_ppo_ratios_are_exact_before_each_update(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first loss of an iteration sees the data under the parameters that collected it."""
    fresh: list[TensorDictBase] = []
    forward = ConstrainedPPOLoss.forward

    def spy(self: ConstrainedPPOLoss, tensordict: TensorDictBase) -> TensorDictBase:
        losses = forward(self, tensordict)
        if len(tensordict) == 960:  # the whole iteration
            fresh.append(losses)
        return losses

    monkeypatch.setattr(ConstrainedPPOLoss, "forward", spy)
    printed = run("ppo_latent", *TINY["ppo_latent"])
    assert len(fresh) == 2
    for losses in fresh:
        assert losses["ESS"].item() == pytest.approx(1, abs=1e-6)
        assert losses["kl_approx"].abs().item() < 1e-6
        assert losses["max_ratio"].item() == pytest.approx(1, abs=1e-5)
        assert losses["clip_fraction"] == 0
    assert re.findall(r"ESS (\S+) and", printed) == ["1.000000", "1.000000"]
