"""Snapshots are what the policy does, and nothing else."""

import pytest
import torch
from tensordict import TensorDict

from cnfp_torchrl.geometry import ConstraintSet
from cnfp_torchrl.visual import take_snapshot
from cnfp_torchrl.visual.snapshot import StagedFlow, stage_bijector
from tests.visual.cases import CONFLICT, PLANE, RELAXED, flows_in_cases, make_snapshot


@flows_in_cases("exact", "radial")
def test_exact_flows_stay_inside_after_every_stage(
    flow: str, sets: dict[str, ConstraintSet], dim: int
) -> None:
    snapshot = make_snapshot(sets, flow, dim=dim, samples=2000)
    assert [stage.name for stage in snapshot.stages] == ["bounds", *sets]
    for index in range(len(snapshot.stages)):
        assert not snapshot.outside(index).any()


@pytest.mark.parametrize("flow", ["squash", "unconstrained"])
def test_other_flows_are_seen_to_break_constraints(flow: str) -> None:
    snapshot = make_snapshot(PLANE, flow, samples=2000)
    last = snapshot.outside(len(snapshot.stages) - 1)
    assert last.any()
    expected = ~snapshot.region.contains(snapshot.stages[-1].samples)
    assert torch.equal(last, expected)


def test_samples_are_the_latents_through_the_stages() -> None:
    snapshot = make_snapshot(PLANE)
    actions, log_density = snapshot.through_stages(snapshot.latents)
    for i, stage in enumerate(snapshot.stages):
        torch.testing.assert_close(actions[i], stage.samples)
        torch.testing.assert_close(log_density[i], stage.log_density)


def test_dropped_constraint_is_named_and_changes_nothing() -> None:
    snapshot = make_snapshot(CONFLICT)
    assert snapshot.dropped == ("far",)
    bounds, far, near = snapshot.stages
    assert not far.active
    assert near.active
    torch.testing.assert_close(far.samples, bounds.samples)


def test_relaxed_constraint_is_widened_as_the_flow_does() -> None:
    snapshot = make_snapshot(RELAXED)
    assert not snapshot.dropped
    _, far, near = snapshot.stages
    assert not far.active
    assert 0 < far.relaxation < torch.inf
    assert near.active
    last = snapshot.stages[-1].samples
    assert not RELAXED["far"].contains(last).any()
    assert RELAXED["far"].inflated(torch.tensor([far.relaxation])).contains(last).all()
    assert not snapshot.outside(2).any()


def test_path_is_that_of_the_followed_sample() -> None:
    snapshot = make_snapshot(PLANE)
    executed = torch.stack([stage.samples[0] for stage in snapshot.stages])
    torch.testing.assert_close(snapshot.path(), executed)

    def length(path: torch.Tensor) -> float:
        return float(path.diff(dim=0).norm(dim=-1).sum())

    longest = snapshot.following_the_longest_path()
    assert length(longest.path()) > length(snapshot.path())


def test_random_numbers_elsewhere_are_left_alone() -> None:
    before = torch.random.get_rng_state()
    make_snapshot(PLANE)
    assert torch.equal(torch.random.get_rng_state(), before)


def test_batch_of_states_is_refused() -> None:
    actor = torch.nn.Identity()
    with pytest.raises(ValueError, match=r"one state .* given \(3,\)"):
        take_snapshot(actor, TensorDict({}, [3]))  # type: ignore[arg-type]


@flows_in_cases("exact", "gauge", "soft", "recession", "radial", "squash", "unconstrained")
def test_stages_are_the_flows_up_to_each(
    flow: str, sets: dict[str, ConstraintSet], dim: int
) -> None:
    snapshot = make_snapshot(sets, flow, dim=dim)
    applied = [stage.applied for stage in snapshot.stages]
    staged = StagedFlow(snapshot.head.flow, snapshot.region, applied)
    actions, log_dets = staged.forward(snapshot.latents)
    latents, inverse_log_dets = staged.inverse(actions[-1])
    for k, stage in enumerate(applied):
        bijector = stage_bijector(snapshot.head.flow, snapshot.region, stage)
        expected = bijector.forward_and_log_det(snapshot.latents)
        torch.testing.assert_close((actions[k], log_dets[k]), expected, rtol=1e-5, atol=1e-5)
        expected = bijector.inverse_and_log_det(actions[-1])
        given = latents[k], inverse_log_dets[k]
        torch.testing.assert_close(given, expected, rtol=1e-4, atol=1e-4, equal_nan=True)


def test_a_saturated_policy_is_shown_by_what_the_flow_does_to_others() -> None:
    saturated = make_snapshot(PLANE, loc=torch.tensor([6.0, -6.0]), scale=torch.full((2,), 0.1))
    assert saturated.is_saturated
    shown = saturated.with_standard_base()
    assert not shown.is_saturated
    assert shown.latents.shape == saturated.latents.shape
    assert not shown.outside(len(shown.stages) - 1).any()
    assert shown.latents.std(0).sub(1).abs().max() < 0.3


def test_the_share_allowed_before_the_flow_is_counted() -> None:
    snapshot = make_snapshot(PLANE)
    squashed = torch.tanh(snapshot.latents)
    inside = [constraint.contains(squashed) for constraint in snapshot.region.sets[1:]]
    assert snapshot.share_allowed_before == torch.stack(inside).all(0).double().mean()
    assert make_snapshot({}).share_allowed_before == 1
