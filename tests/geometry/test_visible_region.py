"""A point that presses on what it must not touch, step after step."""

import pytest
import torch
from torch import Tensor

from cnfp_torchrl.bijectors import ExactSquash
from cnfp_torchrl.geometry import Ball, Box, Region, VisibleRegion

STATES = 100
LATENTS = (0.0, 3.0, 1e6, -1e6)


def arena(dim: int, length: float) -> Tensor:
    """Return walls around the arena, and a rectangle in it, all in float32."""
    wall, half = torch.full((dim,), length), torch.full((dim,), 0.3 * length)
    return torch.cat([VisibleRegion.walls(-wall, wall), torch.stack([-half, half])[None]])


def touches(before: Tensor, after: Tensor, rectangles: Tensor) -> Tensor:
    """Tell by many points on the way, in float64, whether a straight move meets a rectangle."""
    share = torch.linspace(0, 1, 401, dtype=torch.float64).view(-1, 1, 1, 1)
    before, after = (x.double().unsqueeze(-2) for x in (before, after))
    point = before + share * (after - before)
    low, high = rectangles.double().unbind(-2)
    return ((low <= point) & (point <= high)).all(-1).any(-1).any(0)


@pytest.mark.parametrize(
    ("dim", "length", "step"), [(1, 1.0, 0.1), (2, 150.0, 0.1), (2, 0.02, 1.0), (3, 1.0, 0.1)]
)
def test_no_step_of_a_saturated_policy_ends_in_a_wall_or_a_rectangle(
    dim: int, length: float, step: float
) -> None:
    torch.manual_seed(0)
    rectangles = arena(dim, length)
    position = 0.9 * length * (2 * torch.rand(STATES, dim) - 1)
    position = position[~touches(position, position, rectangles)]
    size = torch.tensor(length * 0.4 / step)
    bounds = Box((-size).expand(dim), size.expand(dim))
    # Each agent keeps its direction, so that it is soon pressed into a corner, or on a face.
    direction = torch.randint(len(LATENTS), position.shape)
    latent = torch.tensor(LATENTS)[direction]
    for _ in range(12):
        visible = VisibleRegion(position, rectangles, torch.tensor(step))
        region = Region.build([bounds, visible, Ball(torch.zeros(dim), 3 * size)])
        assert region.is_active.all()
        action = ExactSquash(region)(latent)
        after = position + step * action
        assert not touches(position, after, rectangles).any()
        position = after


def test_next_to_a_face_what_leads_away_is_allowed_and_what_leads_towards_it_is_not() -> None:
    rectangles = torch.tensor([[[1.0, -1.0], [2.0, 1.0]]])
    face = rectangles[0, 0, 0]
    position = torch.stack([torch.nextafter(face, -face), torch.tensor(0.2)])
    visible = VisibleRegion(position, rectangles, torch.tensor(0.1))
    away, along, towards = torch.tensor([[-0.5, 0.1], [-1e-3, 1.0], [1e-3, 0.0]])
    inner = visible.eroded()
    assert inner.contains(away)
    assert inner.contains(along)
    assert not inner.contains(torch.zeros(2))
    assert not inner.contains(towards)
    assert visible.rounding().isfinite().all()
    inside = VisibleRegion(torch.tensor([1.5, 0.0]), rectangles, torch.tensor(0.1))
    assert inside.rounding().isinf().all()
