"""The power of HalfCheetah stays within its limit, read off the simulator itself."""

import ast
import re
import tokenize
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import Compose, DoubleToFloat, GymEnv, TransformedEnv

from cnfp_torchrl.envs import ConstraintAnchor, constraint_bijectors
from cnfp_torchrl.modules import ConstrainedFlowModule
from tests.examples.scripts import load, run

pytest.importorskip("mujoco", reason="needs MuJoCo, of the extra 'examples'")

SCRIPT = Path(__file__).resolve().parents[2] / "experiments" / "examples" / "half_cheetah_power.py"


@pytest.fixture
def powers(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The power of each executed action at the joint velocities of MuJoCo's state, in float64."""
    from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv

    seen: list[float] = []
    step = HalfCheetahEnv.step

    def spy(self: Any, action: np.ndarray) -> Any:
        velocity = np.array([self.data.joint(name).qvel[0] for name in JOINTS])
        seen.append(float(np.abs(velocity * np.asarray(action, dtype=np.float64)).sum()))
        return step(self, action)

    monkeypatch.setattr(HalfCheetahEnv, "step", spy)
    return seen


JOINTS = ["bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"]


def test_learns_within_the_limit(powers: list[float], optimized: Any) -> None:
    printed = run("half_cheetah_power", "--steps", 64)
    assert len(powers) == 64
    assert max(powers) <= 20
    # The script prints it for the velocities that the actor saw, which are float32.
    (largest,) = re.findall(r"largest (\S+),", printed)
    assert float(largest) == pytest.approx(max(powers), abs=1e-4)
    optimized.assert_all_learned()


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_hostile_actions_meet_the_limit_and_not_more(scale: float, powers: list[float]) -> None:
    """Full torque along the velocities at every step: the limit binds nearly always."""

    def along(observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        velocity = observation[..., 11:]
        return 1e6 * velocity.sign(), torch.full_like(velocity, scale)

    env = TransformedEnv(
        GymEnv("HalfCheetah-v5"), Compose(DoubleToFloat(), load(SCRIPT.stem).PowerLimit("power"))
    )
    bijectors = constraint_bijectors(env)
    env.append_transform(ConstraintAnchor(bijectors))
    actor = TensorDictSequential(
        TensorDictModule(along, ["observation"], ["loc", "scale"]),
        ConstrainedFlowModule(env.action_spec_unbatched, bijectors),
    )
    steps: TensorDictBase = env.rollout(200, actor)
    assert bool(steps["constraints", "power", "active"].all())
    assert len(powers) == 200
    assert max(powers) <= 20
    assert np.mean(np.array(powers) > 19.9) > 0.3


def test_unlimited_it_draws_more(powers: list[float]) -> None:
    env = GymEnv("HalfCheetah-v5")
    env.set_seed(0)
    env.rollout(200)
    assert max(powers) > 25


def test_rate_and_power_together(powers: list[float]) -> None:
    printed = run("half_cheetah_limits", "--steps", 64)
    assert len(powers) == 64
    assert max(powers) <= 20
    assert re.findall(r"(rate|power): 0 violations in 64 steps", printed) == ["rate", "power"]


def test_takes_less_than_25_lines() -> None:
    """Everything counts, imports too, but blank lines, comments and docstrings."""
    with SCRIPT.open("rb") as file:
        skipped = {tokenize.ENCODING, tokenize.COMMENT, tokenize.NL, tokenize.ENDMARKER}
        structure = {tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
        tokens = [t for t in tokenize.tokenize(file.readline) if t.type not in skipped | structure]
    lines = {line for t in tokens for line in range(t.start[0], t.end[0] + 1)}
    tree = ast.parse(SCRIPT.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(
            node
        ):
            text = node.body[0]
            assert text.end_lineno is not None
            lines -= set(range(text.lineno, text.end_lineno + 1))
    assert len(lines) < 25
    assert f"in {len(lines)} lines" in (SCRIPT.parent / "README.md").read_text()
