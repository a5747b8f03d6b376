"""All stages of a flow in one pass are the flows up to each of them."""

import pytest
import torch

from cnfp_torchrl.visual.staged_flow import StagedFlow, stage_bijector
from tests.visual.cases import CONFLICT, LINE, PLANE, PLANE_OF_OTHERS, SPACE, make_snapshot

CASES = {
    "no constraint": ({}, 2),
    "three": (PLANE, 2),
    "other families": (PLANE_OF_OTHERS, 2),
    "one is dropped": (CONFLICT, 2),
    "on a line": (LINE, 1),
    "in space": (SPACE, 3),
}


@pytest.mark.parametrize("flow", ["exact", "gauge", "radial", "squash", "unconstrained"])
@pytest.mark.parametrize("case", CASES)
def test_stages_are_the_flows_up_to_each(case: str, flow: str) -> None:
    sets, dim = CASES[case]
    if flow == "squash" and case in ("other families", "in space"):
        pytest.skip("some of these sets have no squash")
    snapshot = make_snapshot(sets, flow, dim=dim)
    applied = [stage.applied for stage in snapshot.stages]
    staged = StagedFlow(snapshot.flow, snapshot.region, applied)
    actions, log_dets = staged.forward(snapshot.latents)
    latents, inverse_log_dets = staged.inverse(actions[-1])
    for k, each in enumerate(applied):
        bijector = stage_bijector(snapshot.flow, snapshot.region, each)
        expected = bijector.forward_and_log_det(snapshot.latents)
        torch.testing.assert_close((actions[k], log_dets[k]), expected, rtol=1e-5, atol=1e-5)
        expected = bijector.inverse_and_log_det(actions[-1])
        given = latents[k], inverse_log_dets[k]
        torch.testing.assert_close(given, expected, rtol=1e-4, atol=1e-4, equal_nan=True)
