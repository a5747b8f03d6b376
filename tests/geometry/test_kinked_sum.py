"""What kinked sums have beyond the properties of every set."""

import pytest
import torch

from cnfp_torchrl.geometry import PositivePart, WeightedL1Ball


@pytest.mark.parametrize("family", [WeightedL1Ball, PositivePart])
def test_bounds_may_have_a_batch_of_their_own(
    family: type[WeightedL1Ball] | type[PositivePart],
) -> None:
    sets = family(torch.ones(2), torch.tensor([1.0, 2.0, 3.0]))
    gauge = sets.gauge(torch.ones(2), torch.zeros(2))
    torch.testing.assert_close(gauge, torch.tensor([2.0, 1.0, 2 / 3]))
