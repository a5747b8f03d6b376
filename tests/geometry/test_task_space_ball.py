"""What task-space balls have beyond the properties of every set: null spaces, other families."""

import pytest
import torch

from cnfp_torchrl.geometry import Ball, Box, Ellipsoid, TaskSpaceBall, lexicographic_anchor
from tests.geometry.cases import DTYPES


def test_an_invertible_map_makes_an_ellipsoid() -> None:
    torch.manual_seed(0)
    tril = torch.randn(5, 3, 3).double().tril(-1) + torch.diag_embed(
        0.3 + torch.rand(5, 3).double()
    )
    center, inverse = torch.randn(5, 3).double(), tril.inverse()
    offset = -(inverse @ center.unsqueeze(-1)).squeeze(-1)
    ball = TaskSpaceBall(inverse, offset, torch.ones(5).double())
    ellipsoid = Ellipsoid(center, tril)
    anchor = center + 0.1 * (tril @ torch.randn(5, 3, 1).double()).squeeze(-1)
    direction = torch.randn(100, 5, 3).double()
    torch.testing.assert_close(ball.gauge(direction, anchor), ellipsoid.gauge(direction, anchor))
    torch.testing.assert_close(ball.slack(anchor + direction), ellipsoid.slack(anchor + direction))


def test_some_rows_of_the_identity_make_a_ball_in_these_components() -> None:
    torch.manual_seed(0)
    center, radius = torch.randn(2).double(), torch.tensor(0.7).double()
    some = TaskSpaceBall(torch.eye(4).double()[1:3], -center, radius)
    ball = Ball(center, radius)
    direction, inside = torch.randn(100, 4).double(), torch.zeros(4).double()
    inside[1:3] = center + 0.3
    torch.testing.assert_close(
        some.gauge(direction, inside), ball.gauge(direction[:, 1:3], inside[1:3])
    )
    torch.testing.assert_close(some.slack(direction), ball.slack(direction[:, 1:3]))


@pytest.mark.parametrize("dtype", DTYPES)
def test_directions_of_the_null_space_have_no_end_and_no_gradient(dtype: torch.dtype) -> None:
    jacobian = torch.tensor([[1.0, 0.0, 2.0], [0.0, 0.0, 1.0]], dtype=dtype)
    ball = TaskSpaceBall(
        jacobian, torch.tensor([0.1, 0.2], dtype=dtype), torch.ones((), dtype=dtype)
    )
    for length in (1e-15, 1.0, 1e6):
        direction = torch.tensor([0.0, length, 0.0], dtype=dtype, requires_grad=True)
        gauge = ball.gauge(direction, torch.zeros(3, dtype=dtype))
        gauge.backward()
        assert gauge == 0
        assert direction.grad is not None
        assert (direction.grad == 0).all()


@pytest.mark.parametrize(("offset", "holds"), [(0.5, True), (1.5, False)])
def test_a_jacobian_of_zero_allows_all_or_nothing(offset: float, holds: bool) -> None:
    zeros = torch.zeros(2, 3, dtype=torch.float64)
    ball = TaskSpaceBall(
        zeros, torch.tensor([offset, 0.0]).double(), torch.ones((), dtype=torch.float64)
    )
    ones = torch.ones(3, dtype=torch.float64)
    actions = torch.randn(20, 3, dtype=torch.float64)
    assert (ball.contains(actions) == holds).all()
    assert ((ball.slack(actions) > 0) == holds).all()
    found = lexicographic_anchor([Box(-ones, ones), ball])
    assert found.active.tolist() == [True, holds]
    assert (ball.gauge(actions, found.anchor) == 0).all()


@pytest.mark.parametrize("unit", [1e-30, 1e-20, 1e-10, 1.0, 1e10, 1e25])
def test_the_unit_of_the_image_does_not_matter(unit: float) -> None:
    jacobian, offset = torch.tensor([[1.0, 0.5]]), torch.tensor([0.1])
    here = TaskSpaceBall(jacobian, offset, torch.tensor(0.2))
    there = TaskSpaceBall(unit * jacobian, unit * offset, torch.tensor(0.2 * unit))
    direction = torch.randn(100, 2)
    for anchor in (torch.zeros(2), torch.tensor([0.05, -0.1])):
        torch.testing.assert_close(there.gauge(direction, anchor), here.gauge(direction, anchor))
        torch.testing.assert_close(there.slack(anchor + direction), here.slack(anchor + direction))
