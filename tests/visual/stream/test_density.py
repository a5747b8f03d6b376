"""The heat maps' numbers are the distribution's."""

import numpy as np
import pytest
import torch
from torch.distributions import Independent, Normal

from cnfp_torchrl.distributions import ConstrainedFlow
from cnfp_torchrl.visual.replay import replay_step
from cnfp_torchrl.visual.staged_flow import stage_bijector
from cnfp_torchrl.visual.stream.density import ActionGrid, as_bytes
from tests.visual.cases import CONFLICT, LINE, PLANE, make_actor, make_state

CASES = {"three": (PLANE, 2), "one is dropped": (CONFLICT, 2), "on a line": (LINE, 1)}


@pytest.mark.parametrize("flow", ["exact", "radial", "squash", "unconstrained"])
@pytest.mark.parametrize("case", CASES)
def test_last_stage_is_the_policys_log_density(case: str, flow: str) -> None:
    sets, dim = CASES[case]
    actor = make_actor(sets, flow, dim=dim, loc=torch.full((dim,), 0.3))
    step = actor(make_state(sets, dim))
    snapshot = replay_step(actor, step, torch.zeros(1, dim))
    grid = ActionGrid(((-1.1, 1.1),) * dim, 31)
    densities = grid.log_densities(snapshot)
    assert densities.shape == (len(snapshot.stages), *(31,) * dim)
    base = Independent(Normal(step["loc"].double(), step["scale"].double()), 1)
    bijector = stage_bijector(
        snapshot.flow, snapshot.region.to(torch.float64), snapshot.stages[-1].applied
    )
    distribution = ConstrainedFlow(base, bijector)
    # A tenth of a step in brightness; bounds of float32 are eroded by more than those of float64.
    expected = distribution.log_prob(grid.actions.double())
    torch.testing.assert_close(densities[-1].double(), expected, atol=0.1 * 7 / 255, rtol=0)


@pytest.mark.parametrize("flow", ["exact", "radial", "squash"])
def test_every_stage_integrates_to_one(flow: str) -> None:
    actor = make_actor(PLANE, flow)
    snapshot = replay_step(actor, actor(make_state(PLANE)), torch.zeros(1, 2))
    reach = 2.0
    grid = ActionGrid(((-reach, reach),) * 2, 400)
    densities = grid.log_densities(snapshot).exp()
    mass = densities.sum((1, 2)) * (2 * reach / 400) ** 2
    # The cells that a boundary cuts count as a whole or not at all.
    torch.testing.assert_close(mass, torch.ones_like(mass), atol=0.03, rtol=0)


def test_bytes_share_one_scale() -> None:
    low, high = torch.full((4, 4), -2.0), torch.full((4, 4), 1.0)
    high[0, 0] = -torch.inf
    dark, bright = as_bytes(torch.stack([low, high]).double())
    assert bright[0, 0] == 0
    assert (bright.reshape(-1)[1:] == 255).all()
    np.testing.assert_array_equal(dark, round(255 * 4 / 7))


def test_no_density_anywhere_is_dark() -> None:
    assert not as_bytes(torch.full((2, 3, 3), -torch.inf).double()).any()
