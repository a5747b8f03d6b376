"""The deterministic layer: allowed actions out of any output, and a nominal action left alone."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cnfp_torchrl.geometry import Ball, Box, GeometryError, HalfSpaces, Region
from cnfp_torchrl.modules import ConstraintLayer


def region(dtype: torch.dtype = torch.float64, count: int = 64) -> Region:
    """Random states of bounds, a ball and half-spaces that hold an anchor of their own."""
    random = torch.Generator().manual_seed(0)
    anchor = 0.6 * (2 * torch.rand(count, 2, generator=random, dtype=torch.float64) - 1)
    normals = torch.randn(count, 3, 2, generator=random, dtype=torch.float64)
    room = (0.05 + torch.rand(count, 3, generator=random).double()) * normals.norm(dim=-1)
    half_spaces = HalfSpaces(normals, (normals * anchor.unsqueeze(-2)).sum(-1) + room)
    ones = torch.ones(2, dtype=torch.float64)
    ball = Ball(anchor + 0.1, torch.full((count,), 0.5, dtype=torch.float64))
    return Region((Box(-ones, ones), ball, half_spaces), anchor).to(dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("with_nominal", [False, True])
def test_outputs_of_any_size_become_allowed_actions(dtype: torch.dtype, with_nominal: bool) -> None:
    sets, layer = region(dtype), ConstraintLayer()
    exact = sets.to(torch.float64)
    for size in (0.0, 1.0, 1e3, 1e6, 1e15):
        output = size * torch.randn(200, 64, 2, dtype=dtype)
        nominal = torch.randn(200, 64, 2, dtype=dtype) if with_nominal else None
        action = layer(output, sets, nominal)
        assert action.dtype == dtype
        assert exact.contains(action.double()).all()


def test_a_nominal_action_stays_where_it_is_allowed() -> None:
    sets = region()
    nominal = sets.anchor + 0.3 * torch.randn(500, 64, 2, dtype=torch.float64)
    gauge = sets.gauges(nominal - sets.anchor)[-1]
    action = ConstraintLayer(room=0.1)(torch.zeros_like(nominal), sets, nominal)
    moved = (action - nominal).abs().amax(-1)
    assert (gauge < 0.899).sum() > 1000
    assert (gauge > 1).sum() > 1000
    assert moved[gauge < 0.899].max() < 1e-12
    # Between there and the boundary it moves by less than the room itself.
    near = (gauge >= 0.899) & (gauge <= 1)
    assert (moved[near] <= 0.1 * (nominal - sets.anchor).norm(dim=-1)[near] * 1.2).all()
    # A small correction passes unchanged, to second order.
    correction = torch.full_like(nominal, 1e-4)
    corrected = ConstraintLayer()(correction, sets, nominal)
    assert (corrected - nominal - correction)[gauge < 0.5].abs().max() < 2e-6


@pytest.mark.parametrize("with_nominal", [False, True])
def test_gradients_reach_output_nominal_and_fields(with_nominal: bool) -> None:
    ones = torch.ones(2, dtype=torch.float64)

    def act(output: Tensor, offsets: Tensor, nominal: Tensor) -> Tensor:
        rows = HalfSpaces(torch.eye(2, dtype=torch.float64), offsets, validate_args=False)
        sets = Region((Box(-2 * ones, 2 * ones), rows), torch.zeros(2, dtype=torch.float64))
        return ConstraintLayer()(output, sets, nominal if with_nominal else None)

    output, nominal = torch.randn(2, 5, 2, dtype=torch.float64).unbind()
    offsets = 0.3 + torch.rand(5, 2, dtype=torch.float64)
    given = [leaf.requires_grad_() for leaf in (output, offsets, nominal)]
    if not with_nominal:
        given[2] = nominal.detach()
    assert torch.autograd.gradcheck(act, given)


def test_sets_in_the_place_of_a_region_and_a_gradient_step() -> None:
    """A network learns to go as far right as the sets allow: 0.5 and not a bit further."""
    network = torch.nn.Linear(1, 2)
    bounds = Box(-torch.ones(2), torch.ones(2))
    wall = HalfSpaces(torch.tensor([[1.0, 0.0]]), torch.tensor([0.5]))
    layer, x = ConstraintLayer("soft"), torch.ones(1, 1)
    optimizer = torch.optim.Adam(network.parameters(), lr=0.1)
    for _ in range(100):
        action = layer(network(x), (bounds, wall))
        optimizer.zero_grad()
        (-action[:, 0].sum()).backward()
        optimizer.step()
    assert 0.48 < action[0, 0] <= 0.5


def test_what_does_not_fit_is_refused() -> None:
    sets, layer = region(), ConstraintLayer()
    with pytest.raises(
        ValueError, match=r"flow: expected .*'soft' or 'recession', given ExactFlow"
    ):
        ConstraintLayer("exact")
    with pytest.raises(ValueError, match="room: expected a number between 0 and 1, given 1"):
        ConstraintLayer(room=1)
    with pytest.raises(GeometryError, match=r"output: expected a tensor \(\*batch, 2\) of .*64"):
        layer(torch.zeros(64, 3, dtype=torch.float64), sets)
    with pytest.raises(GeometryError, match=r"nominal: expected .*float32"):
        layer(torch.zeros(64, 2, dtype=torch.float64), sets, torch.zeros(64, 2))
    with pytest.raises(GeometryError, match="anchor: expected a point strictly inside"):
        layer(torch.zeros(64, 2, dtype=torch.float64), Region(sets.sets))


def test_barriers_without_bounds_or_anchor() -> None:
    """The recession keeps half-spaces alone, where a soft retraction needs an anchor."""
    infinite = torch.full((2,), torch.inf)
    rows = HalfSpaces(torch.tensor([[1.0, 0.2], [0.1, 1.0]]), torch.tensor([0.5, 0.0]))
    layer, sets = ConstraintLayer("recession"), (Box(-infinite, infinite), rows)
    output = torch.cat([10.0**k * torch.randn(500, 2) for k in range(9)])
    assert rows.contains(layer(output, sets)).all()
    safe = torch.tensor([-30.0, -40.0])
    torch.testing.assert_close(layer(torch.zeros(2), sets, safe), safe)
    with pytest.raises(GeometryError, match="finite bounds"):
        ConstraintLayer("soft")(output, sets)
