"""Safe control: rows by hand against the judge by automatic differentiation; published starts."""

from functools import partial

import pytest
import torch
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.audit import AuditSettings, audit
from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.modules import flow_head
from cnfp_torchrl.tasks.safe_control import (
    Problem,
    SafeControlEnv,
    barrier_excess,
    barrier_rows,
    episode,
    nominal_control,
    starts,
)
from cnfp_torchrl.tasks.safe_control.judge import barrier_values, ellipse_values
from cnfp_torchrl.training.agent import build_actor, build_environment

PROBLEM = Problem()


def test_rows_are_the_judge_s() -> None:
    torch.manual_seed(0)
    state, control = 2 * torch.randn(500, 5).double(), 20 * torch.randn(500, 2).double()
    rows = barrier_rows(PROBLEM, state)
    by_rows = (rows.normals @ control.unsqueeze(-1)).squeeze(-1) - rows.offsets
    judged = barrier_excess(PROBLEM, state, control)
    torch.testing.assert_close(by_rows, judged, rtol=1e-7, atol=1e-5)
    # The rows are the stricter ones, by more than rounding.
    assert (by_rows > judged).all()


def test_starts_are_safe_and_the_same_each_time() -> None:
    states = starts(partial(barrier_values, PROBLEM))
    assert states.shape == (1000, 5)
    assert (barrier_values(PROBLEM, states) >= 0).all()
    torch.testing.assert_close(states, starts(partial(barrier_values, PROBLEM)))


def test_the_nominal_controller_runs_into_the_obstacles_and_is_told() -> None:
    states = starts(partial(barrier_values, PROBLEM))[:20]
    run = episode(PROBLEM, states, nominal_control, judge=partial(barrier_excess, PROBLEM))
    assert run.violations > 0
    assert run.largest > 0
    assert (ellipse_values(PROBLEM, states) > 0).all()


def environment(
    agents: int, flow: str = "exact"
) -> tuple[TransformedEnv, SafeProbabilisticTensorDictSequential]:
    """Return the shipped environment, with anchors, and an actor of a flow."""
    config = compose_config("env=safe_control", f"flow={flow}")
    env = build_environment(config, batch_size=[agents], with_anchor=True)
    env.set_seed(0)
    return env, build_actor(config, env)


def test_the_environment_moves_and_costs_what_an_episode_does() -> None:
    env = SafeControlEnv([7], seed=0)
    check_env_specs(env)
    shown = env.reset()
    start, total = shown["state"], torch.zeros(7)
    for _ in range(50):
        action = nominal_control(shown["state"]).clamp(-100, 100).float()
        shown = env.step(shown.set("action", action))["next"]
        total = total - shown["reward"].squeeze(-1)
    assert shown["truncated"].all()
    run = episode(PROBLEM, start, nominal_control)
    torch.testing.assert_close(total, run.cost.float(), rtol=1e-4, atol=1e-4)
    with pytest.raises(ValueError, match=r"action at index \[0, 1\]: expected a finite number"):
        env.step(env.reset().set("action", torch.tensor([[0.0, torch.nan]]).expand(7, 2)))


@pytest.mark.parametrize("flow", ["exact", "soft", "recession", "projection"])
def test_hostile_actions_break_no_barrier_while_it_is_active(flow: str) -> None:
    torch.manual_seed(0)
    env, actor = environment(100, flow)
    head = flow_head(actor)
    state, active = env.reset(), 0
    for _ in range(50):
        latent = torch.randn(100, 2) * 10 ** (8 * torch.rand(100, 1) - 2)
        shown = env.step(state.set("action", head.get_bijector(state)(latent)))
        holds = state["constraints", "barriers", "active"]
        assert not (shown["next", "cost"].squeeze(-1) > 0)[holds].any()
        active += int(holds.sum())
        state = env.step_mdp(shown)
    assert active > 4500


def test_the_audit_finds_barriers_sound_and_whole() -> None:
    settings = AuditSettings(states=16, actions=8, steps=20)
    report = audit(environment(16)[0], settings=settings)
    assert not [flaw for flaw in report.flaws if "unsound" in str(flaw) or "escaped" in str(flaw)]
