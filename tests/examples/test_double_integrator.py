"""The barrier of the double integrator is invariant, and no control crosses the wall."""

from types import ModuleType

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from tests.examples.scripts import load, run

DT, NORMAL, BRAKING = 0.05, np.array([0.6, 0.8]), 0.9 * 1.4
TOWARDS = torch.tensor([0.6, 0.8])


@pytest.fixture
def script() -> ModuleType:
    return load("double_integrator_cbf")


def straight(observation: Tensor) -> tuple[Tensor, Tensor]:
    """Press into the wall with all force, without noise."""
    force = 1e6 * TOWARDS.expand(len(observation), 2)
    return force, torch.full_like(force, 1e-8)


def bang(observation: Tensor) -> tuple[Tensor, Tensor]:
    """Draw a corner of the action bounds at every step."""
    corner = 1e6 * torch.randn(len(observation), 2).sign()
    return corner, torch.full_like(corner, 1e-8)


def along(observation: Tensor) -> tuple[Tensor, Tensor]:
    """Gather speed along the wall and press into it, with noise of all sizes."""
    force = 1e3 * (TOWARDS + torch.tensor([0.8, -0.6])).expand(len(observation), 2)
    return force, torch.logspace(-6, 6, len(observation)).unsqueeze(-1).expand(-1, 2)


CONTROLS = {"straight": straight, "bang": bang, "along": along}


@pytest.mark.parametrize("name", ["push", *CONTROLS])
def test_no_control_crosses_the_wall(name: str, script: ModuleType) -> None:
    control = CONTROLS.get(name) or script.push
    steps = script.run(control, steps=500, agents=64)
    assert bool(steps["constraints", "wall", "active"].all())
    assert bool((steps["action"].abs() <= 1).all())
    start = steps["observation"].double().numpy()
    end = steps["next", "observation"].double().numpy()
    assert start.shape == (64, 500, 4)

    gap = 1 - start[..., :2] @ NORMAL
    speed, later = start[..., 2:] @ NORMAL, end[..., 2:] @ NORMAL
    # The gap is smallest where the speed passes through 0: s^2 dt / (2 (s - y)) is covered by then.
    turns = (speed > 0) & (later < 0)
    way = speed**2 * DT / (2 * np.where(turns, speed - later, 1))
    assert (gap >= 0).all()
    assert (1 - end[..., :2] @ NORMAL >= 0).all()
    assert (gap - np.where(turns, way, 0) >= 0).all()
    # It is the wall that holds them, not a timid barrier.
    if name != "bang":
        assert gap.min() < 0.01


def test_without_the_barrier_they_cross(script: ModuleType) -> None:
    steps = script.run(script.push, steps=200, agents=32, unsafe=True)
    gap = 1 - steps["next", "observation"][..., :2].double().numpy() @ NORMAL
    assert (gap < 0).any(-1).mean() > 0.9


def test_barrier_is_invariant_and_not_tighter_than_it_needs_to_be(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The derivation, in float64: any allowed action leads from a safe state to a safe one."""
    monkeypatch.setattr(script, "NORMAL", torch.tensor([0.6, 0.8], dtype=torch.float64))
    monkeypatch.setattr(script, "BRAKING", BRAKING)
    monkeypatch.setattr(script, "MARGIN", 0.0)
    generator = np.random.default_rng(0)
    speed = np.concatenate(
        [generator.uniform(-5, 5, 20000), np.zeros(100), DT * BRAKING * np.ones(100)]
    )
    # Many states lie on the barrier or a hair inside.
    gap = stopping(speed) + 10.0 ** generator.uniform(-15, 1, speed.size) * generator.integers(
        0, 2, speed.size
    )
    state = np.concatenate([np.outer(1 - gap, NORMAL), np.outer(speed, NORMAL)], axis=-1)
    allowed = script.Barrier("wall").constraint_set(
        TensorDict({"observation": torch.from_numpy(state)}, [speed.size])
    )
    most = allowed.offsets[:, 0].numpy()

    assert (most >= -BRAKING - 1e-9).all()
    for share in (0, 0.3, 1):  # from the strongest braking to the most that is allowed
        action = -1.4 + share * (np.minimum(most, 1.4) + 1.4)
        after = speed + DT * action
        left = gap - DT * (speed + after) / 2
        assert (left - stopping(after) >= -1e-9).all()
    # A little more than allowed is unsafe.
    after = speed + DT * (most + 1e-3)
    assert (gap - DT * (speed + after) / 2 - stopping(after) < 0).all()


def stopping(speed: np.ndarray) -> np.ndarray:
    towards = np.maximum(speed, 0)
    return DT * towards / 2 + towards**2 / (2 * BRAKING)


def test_prints_the_outcome() -> None:
    printed = run("double_integrator_cbf", "--steps", 100, "--agents", 16)
    assert "0 of 16 agents crossed the wall" in printed
    assert "0 of 1600 steps beyond" in printed


@pytest.mark.filterwarnings("ignore::cnfp_torchrl.envs.RelaxedEverywhereWarning")
@pytest.mark.parametrize("name", ["push", "straight"])
def test_entered_too_fast_it_brakes_as_hard_as_it_can(
    name: str, script: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At speed 3 the wall cannot be kept, and the policy, which pushes on, is slowed."""

    def fast(self: object, tensordict: object = None) -> TensorDict:
        position = torch.zeros(64, 2)
        observation = torch.cat([position, 3 * TOWARDS.expand(64, 2)], dim=-1)
        return TensorDict({"observation": observation}, [64])

    monkeypatch.setattr(script.DoubleIntegrator, "_reset", fast)
    control = CONTROLS.get(name) or script.push
    steps = script.run(control, steps=120, agents=64)
    start, end = (steps[key].double() for key in ("observation", ("next", "observation")))
    towards = TOWARDS.double()
    gap, speed = 1 - end[..., :2] @ towards, start[..., 2:] @ towards
    pushed = steps["action"].double() @ towards
    relaxed = ~steps["constraints", "wall", "active"]
    assert relaxed[:, 0].all()
    # The hardest braking of the action bounds, up to the leeway, a thousandth of their width, and
    # what float32 can tell apart of a half-space 60 away.
    beyond = steps["constraints", "wall", "relaxation"][relaxed] > 0.01
    assert (pushed[relaxed][beyond] < -1.4 + 1e-3 * 2 + 3e-3).all()
    # From speed 3 that takes 3^2 / (2 * 1.4); without braking they would go on for ever.
    assert gap.min() > 1 - 9 / 2.8 - 0.05
    assert speed[:, -1].max() < 0.05
