"""The stages of a flow: what each one is, and that the last one is the flow."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cnfp_torchrl.bijectors import BoxSquash
from cnfp_torchrl.geometry import Ball, Box
from tests.bijectors.cases import CASES, DTYPES, Case, cast, latents, latents_of, tensor
from tests.bijectors.numeric import log_abs_det

ids = {"ids": lambda case: case.name}
RETRACTING = ("exact", "gauge", "soft", "soft-rays")
OTHERS = ("radial", "retraction", "soft-alone", "recession")
INTERSECTING = [case for case in CASES if case.kind in (*RETRACTING, *OTHERS)]


def stage_count(case: Case) -> int:
    return 1 if case.kind == "squash" else len(case.sets)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("case", CASES, **ids)
def test_last_stage_is_the_flow(case: Case, dtype: torch.dtype) -> None:
    bijector = case.build(dtype)
    z = latents(case, 20, dtype)
    stages = bijector.stages(z)
    action, log_det = bijector.forward_and_log_det(z)
    assert stages.actions.shape == (stage_count(case), *z.shape)
    assert stages.log_dets.shape == (stage_count(case), *z.shape[:-1])
    # The same arithmetic over tensors of other shapes, whose kernels may round differently.
    eps = 64 * torch.finfo(dtype).eps * case.tightness
    torch.testing.assert_close(stages.actions[-1], action, rtol=eps, atol=eps * case.size)
    torch.testing.assert_close(stages.log_dets[-1], log_det, rtol=eps, atol=eps * case.dim)


@pytest.mark.parametrize("case", [case for case in CASES if case.kind in RETRACTING], **ids)
def test_first_stage_is_the_squash_into_the_bounds(case: Case) -> None:
    bounds = cast(case.sets[0], torch.float64)
    z = latents(case, 20, torch.float64)
    action, log_det = BoxSquash(bounds.low, bounds.high).forward_and_log_det(z)
    bijector = case.build(torch.float64)
    stages = bijector.stages(z)
    torch.testing.assert_close(stages.actions[0], action.expand_as(stages.actions[0]))
    torch.testing.assert_close(stages.log_dets[0], log_det.expand_as(stages.log_dets[0]))
    again, reference_log_det = bijector.forward_and_reference_log_det(z)
    torch.testing.assert_close(reference_log_det, stages.log_dets[0], rtol=1e-12, atol=1e-10)
    torch.testing.assert_close(again, stages.actions[-1], rtol=1e-10, atol=1e-12 * case.size)


@pytest.mark.parametrize("case", [case for case in CASES if case.kind == "radial"], **ids)
def test_reference_of_the_radial_squash_is_its_first_stage(case: Case) -> None:
    bijector = case.build(torch.float64)
    z = latents(case, 20, torch.float64)
    action, log_det = bijector.forward_and_reference_log_det(z)
    stages = bijector.stages(z)
    torch.testing.assert_close(action, stages.actions[-1], rtol=1e-10, atol=1e-12 * case.size)
    torch.testing.assert_close(log_det, stages.log_dets[0], rtol=1e-12, atol=1e-10)


@pytest.mark.parametrize("case", [case for case in CASES if case.kind != "recession"], **ids)
def test_log_dets_accumulate(case: Case) -> None:
    bijector = case.build(torch.float64)
    z = latents_of(case, 4, torch.float64, (0.5, 3.0))

    def each_stage(x: Tensor) -> Tensor:
        """Return the i-th stage of the i-th row."""
        return bijector.stages(x).actions.diagonal(dim1=0, dim2=1).movedim(-1, 0)

    expected = log_abs_det(each_stage, z.expand(stage_count(case), *z.shape))
    assert (bijector.stages(z).log_dets - expected).abs().max() < 1e-9 + case.cancellation


@pytest.mark.parametrize("case", INTERSECTING, **ids)
def test_each_stage_is_inside_the_sets_so_far(case: Case) -> None:
    bijector = case.build(torch.float32)
    z = latents_of(case, 100, torch.float32, (0.0, 1e-12, 1.0, 20.0, 1e6))
    for stage, action in enumerate(bijector.stages(z).actions):
        for earlier in range(stage + 1):
            assert case.allows_stage(earlier, action).all()


@pytest.mark.parametrize("case", [case for case in CASES if case.kind == "chain"], **ids)
def test_each_stage_of_the_chain_is_inside_its_own_set(case: Case) -> None:
    bijector = case.build(torch.float32)
    actions = bijector.stages(latents(case, 100, torch.float32, 1e6)).actions
    for stage, action in enumerate(actions):
        assert case.allows_stage(stage, action).all()


@pytest.mark.parametrize("kind", RETRACTING)
def test_a_dropped_set_changes_nothing(kind: str) -> None:
    case = next(case for case in CASES if case.name == f"{kind}-dropped-d3-batch")
    assert case.active is not None
    stages = case.build(torch.float64).stages(latents(case, 50, torch.float64))
    for stage in range(1, len(case.sets)):
        same = (stages.actions[stage] == stages.actions[stage - 1]).all(-1).all(0)
        assert same[~case.active[:, stage]].all()
        assert not same[case.active[:, stage]].all()


def test_a_box_leaves_the_motion_along_it_alone() -> None:
    """What exact and radial retractions differ in, and that they agree without boxes."""
    bounds, wall = (
        Box(tensor(-1.0, -1.0), tensor(1.0, 1.0)),
        Box(tensor(-2.0, -2.0), tensor(2.0, 0.1)),
    )
    far = tensor(20.0, 20.0)
    exact, radial = (
        Case("", kind, (bounds, wall), tensor(0.0, 0.0)).build(torch.float64)
        for kind in ("exact", "gauge")
    )
    torch.testing.assert_close(exact(far), tensor(1.0, 0.1), rtol=0, atol=1e-6)
    torch.testing.assert_close(radial(far), tensor(0.1, 0.1), rtol=0, atol=1e-6)
    ball = Ball(tensor(0.3, 0.0), tensor(0.9).squeeze())
    exact, radial = (
        Case("", kind, (bounds, ball), tensor(0.0, 0.0)).build(torch.float64)
        for kind in ("exact", "gauge")
    )
    z = torch.randn(100, 2, dtype=torch.float64)
    for given, expected in zip(
        exact.forward_and_log_det(z), radial.forward_and_log_det(z), strict=True
    ):
        torch.testing.assert_close(given, expected, rtol=0, atol=1e-14)
