"""The way of an executed action, found again from the recorded step."""

from collections.abc import Mapping

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.geometry import ConstraintSet
from cnfp_torchrl.geometry.anchor import LEEWAY
from cnfp_torchrl.modules import flow_head
from cnfp_torchrl.visual.replay import replay_step
from tests.visual.cases import CASES, PLANE, RELAXED, flows_in_cases, make_actor, make_state

NOISE = torch.randn(64, 3, generator=torch.Generator().manual_seed(0))
# Sets of float32 are eroded by 16 units of rounding error of the bounds' width 2; three in a chain.
ERODED = 3 * 16 * 2 * torch.finfo(torch.float32).eps


def taken(
    sets: Mapping[str, ConstraintSet], dim: int, flow: str, latent: Tensor
) -> tuple[SafeProbabilisticTensorDictSequential, TensorDictBase, Tensor]:
    """Return an actor, a step in which it drew a latent, and the actions after its stages."""
    actor = make_actor(sets, flow, dim=dim)
    step = make_state(sets, dim)
    step["loc"], step["scale"] = torch.full((dim,), 0.1), torch.full((dim,), 0.7)
    stages = flow_head(actor).get_dist(step).stages(latent).actions
    step["action"] = stages[-1]
    return actor, step, stages


def in_float64(step: TensorDictBase) -> TensorDictBase:
    return step.apply(lambda value: value.double() if value.is_floating_point() else value)


# The rounding margin of a visible region depends on more than the bounds.
@flows_in_cases(
    "exact", "radial", "squash", "unconstrained", cases=[n for n in CASES if n != "other families"]
)
@pytest.mark.parametrize("length", [0.0, 0.3, 2.0])
def test_path_is_the_one_that_was_taken(
    flow: str, sets: dict[str, ConstraintSet], dim: int, length: float
) -> None:
    latent = length * torch.tensor([0.8, -0.6, 0.4])[:dim]
    actor, step, stages = taken(sets, dim, flow, latent)
    snapshot = replay_step(actor, step, NOISE[:, :dim])
    assert snapshot.is_recovered
    # The inverse of a squash of the paper divides rounding errors by a derivative of tanh.
    atol = 100 * ERODED if flow == "squash" else ERODED
    if sets is RELAXED and flow in ("exact", "radial"):
        # What a relaxed set leaves open is as thin as the leeway, of which erosion takes a share.
        atol = ERODED / LEEWAY
    torch.testing.assert_close(snapshot.path(), stages, rtol=0, atol=atol)
    torch.testing.assert_close(snapshot.latents[0], latent, rtol=1e-4, atol=4 * atol)
    # The widened ball is twice as wide as the bounds, and so is its erosion.
    eroded = 2 * ERODED if sets is RELAXED else ERODED
    reached = flow_head(actor).get_dist(in_float64(step)).stages(snapshot.latents[0].double())
    torch.testing.assert_close(reached.actions[-1].float(), step["action"], rtol=0, atol=eroded)
    assert torch.equal(snapshot.path()[-1], step["action"])


@pytest.mark.parametrize("flow", ["exact", "radial", "unconstrained"])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_saturated_actions_have_a_path_too(flow: str, sign: float) -> None:
    latent = sign * torch.tensor([30.0, -9.0])
    actor, step, stages = taken(PLANE, 2, flow, latent)
    snapshot = replay_step(actor, step, NOISE[:, :2])
    assert snapshot.is_recovered
    torch.testing.assert_close(snapshot.path(), stages, rtol=0, atol=ERODED)
    assert torch.equal(snapshot.path()[-1], step["action"])


def test_log_density_of_the_executed_action_is_the_distributions() -> None:
    actor, step, _ = taken(PLANE, 2, "exact", torch.tensor([0.4, -0.9]))
    snapshot = replay_step(actor, step, NOISE[:, :2])
    expected = flow_head(actor).get_dist(in_float64(step)).log_prob(step["action"].double())
    torch.testing.assert_close(snapshot.stages[-1].log_density[0], expected.float())


def test_recorded_gaussian_is_taken_and_not_the_networks() -> None:
    actor, step, _ = taken(PLANE, 2, "exact", torch.tensor([0.4, -0.9]))
    snapshot = replay_step(actor, step, NOISE[:, :2])
    torch.testing.assert_close(snapshot.loc, step["loc"])
    expected = step["loc"] + step["scale"] * NOISE[:, :2]
    torch.testing.assert_close(snapshot.latents[1:], expected)


def test_missing_gaussian_is_the_networks() -> None:
    actor, step, _ = taken(PLANE, 2, "exact", torch.tensor([0.4, -0.9]))
    before = torch.random.get_rng_state()
    snapshot = replay_step(actor, step.exclude("loc", "scale"), NOISE[:, :2])
    assert torch.equal(snapshot.loc, torch.zeros(2))
    assert torch.equal(snapshot.path()[-1], step["action"])
    assert torch.equal(torch.random.get_rng_state(), before)


def test_action_of_another_policy_stands_still() -> None:
    actor, step, _ = taken(PLANE, 2, "exact", torch.zeros(2))
    step["action"] = torch.tensor([-0.95, -0.95])  # outside the battery's ball
    snapshot = replay_step(actor, step, NOISE[:, :2])
    assert not snapshot.is_recovered
    assert torch.equal(snapshot.path(), step["action"].expand(4, 2))


def test_anchor_is_found_where_the_flow_needs_none() -> None:
    actor, step, _ = taken(PLANE, 2, "squash", torch.tensor([0.4, -0.9]))
    del step["constraints", "anchor"]
    snapshot = replay_step(actor, step, NOISE[:, :2])
    assert snapshot.region.contains(snapshot.region.anchor)
    assert snapshot.region.active is not None
    assert snapshot.region.active.all()


def test_step_is_not_changed() -> None:
    actor, step, _ = taken(PLANE, 2, "exact", torch.tensor([0.4, -0.9]))
    before = step.clone()
    replay_step(actor, step, NOISE[:, :2])
    assert (step == before).all()
    assert set(step.keys(True, True)) == set(before.keys(True, True))


def test_batch_of_steps_is_refused() -> None:
    actor, step, _ = taken(PLANE, 2, "exact", torch.zeros(2))
    with pytest.raises(ValueError, match=r"one step .* given \(3,\)"):
        replay_step(actor, step.expand(3), NOISE[:, :2])


def test_missing_action_is_named() -> None:
    actor, step, _ = taken(PLANE, 2, "exact", torch.zeros(2))
    with pytest.raises(KeyError, match="expected action, found keys"):
        replay_step(actor, step.exclude("action"), NOISE[:, :2])
