"""Snapshots are what the policy does, and nothing else."""

import pytest
import torch
from tensordict import TensorDict

from cnfp_torchrl.visual import take_snapshot
from cnfp_torchrl.visual.density import base_log_density
from cnfp_torchrl.visual.flow_stages import stage_grids
from tests.visual.cases import CONFLICT, LINE, PLANE, SPACE, make_snapshot

DIMENSIONS = {1: LINE, 2: PLANE, 3: SPACE}


@pytest.mark.parametrize("flow", ["exact", "radial"])
@pytest.mark.parametrize("dim", DIMENSIONS)
def test_exact_flows_stay_inside_after_every_stage(flow: str, dim: int) -> None:
    snapshot = make_snapshot(DIMENSIONS[dim], flow, dim=dim, samples=2000)
    assert [stage.name for stage in snapshot.stages] == ["bounds", *DIMENSIONS[dim]]
    for index in range(len(snapshot.stages)):
        assert not snapshot.outside(index).any()


@pytest.mark.parametrize("flow", ["squash", "unconstrained"])
def test_other_flows_are_seen_to_break_constraints(flow: str) -> None:
    snapshot = make_snapshot(PLANE, flow, samples=2000)
    last = snapshot.outside(len(snapshot.stages) - 1)
    assert last.any()
    expected = ~snapshot.region.contains(snapshot.stages[-1].samples)
    assert torch.equal(last, expected)


@pytest.mark.parametrize("flow", ["exact", "radial", "squash"])
@pytest.mark.parametrize("dim", [1, 2])
def test_density_of_every_stage_integrates_to_one(
    flow: str, dim: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cnfp_torchrl.visual.density._NODES", 201)
    monkeypatch.setattr("cnfp_torchrl.visual.density._NODES_IN_ONE", 4001)
    snapshot = make_snapshot(DIMENSIONS[dim], flow, dim=dim)
    grids = stage_grids(snapshot)
    assert grids is not None
    assert len(grids) == len(snapshot.stages)
    for points, log_density in grids:
        density = log_density.double().exp()
        points = points.double()
        if dim == 1:
            mass = torch.trapezoid(density, points[:, 0])
        else:
            one = points[1:, 1:] - points[:-1, :-1]
            other = points[:-1, 1:] - points[1:, :-1]
            area = (one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]).abs() / 2
            corners = density[1:, 1:] + density[:-1, :-1] + density[:-1, 1:] + density[1:, :-1]
            mass = (area * corners / 4).sum()
        # The grid ends at 3.2 standard deviations, and jumps lie within its cells.
        assert mass == pytest.approx(1, abs=0.02)


def test_base_density_is_the_gaussians() -> None:
    snapshot = make_snapshot(PLANE, loc=torch.tensor([0.3, -1.0]), scale=torch.tensor([0.2, 1.5]))
    drawn = base_log_density(snapshot, snapshot.latents)
    torch.testing.assert_close(drawn, snapshot.latent_log_density)


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


def test_path_is_that_of_the_followed_sample() -> None:
    snapshot = make_snapshot(PLANE)
    executed = torch.stack([stage.samples[0] for stage in snapshot.stages])
    torch.testing.assert_close(snapshot.path(), executed)

    def length(path: torch.Tensor) -> float:
        return float(path.diff(dim=0).norm(dim=-1).sum())

    longest = snapshot.following_the_longest_path()
    assert length(longest.path()) > length(snapshot.path())


def test_allowed_share() -> None:
    assert make_snapshot({}).allowed_share() == 1
    snapshot = make_snapshot({"obstacle": PLANE["obstacle"]})
    assert snapshot.allowed_share() == pytest.approx(1.5 * 1.4 / 4, abs=0.02)


def test_random_numbers_elsewhere_are_left_alone() -> None:
    before = torch.random.get_rng_state()
    make_snapshot(PLANE)
    assert torch.equal(torch.random.get_rng_state(), before)


def test_batch_of_states_is_refused() -> None:
    actor = torch.nn.Identity()
    with pytest.raises(ValueError, match=r"one state .* given \(3,\)"):
        take_snapshot(actor, TensorDict({}, [3]))  # type: ignore[arg-type]
