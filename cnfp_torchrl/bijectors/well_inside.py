"""Actions of others, moved to where a bijector's densities are finite."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.bijectors.bijector import Bijector

_HALVINGS = 30


def reach(bijector: Bijector, action: Tensor) -> tuple[Tensor, Tensor]:
    """Return a point of the image, and how far the image goes from it towards each action.

    The point is the anchor, where the bijector has one, else the action of latent 0. The images of
    this package's bijectors are star-shaped about it.

    Args:
        bijector: The bijector.
        action: The actions ``(*batch, d)``, finite, inside of the image or not.

    Returns:
        The point ``(*batch, d)``, and the largest share ``(*batch,)`` of the way from it to the
        action that remains in the image: below 1 the action is outside.
    """
    region = getattr(bijector, "region", None)
    if region is None:
        origin = bijector(torch.zeros_like(action))
        return origin, _bisected(bijector, origin, action - origin)
    offset = action - region.anchor
    length = vector_norm(offset, dim=-1)
    # Along a unit vector, which gauges are homogeneous in, so that far actions do not overflow.
    unit = offset / torch.where(length > 0, length, 1).unsqueeze(-1)
    gauge = region.outer_and_inner_gauge(unit)[1] * length
    return region.anchor.expand_as(action), gauge.reciprocal()


def well_inside(bijector: Bijector, action: Tensor, depth: float) -> Tensor:
    """Return each action, pulled along a ray until a share of the way to the boundary is left.

    Args:
        bijector: The bijector whose image the actions are pulled into.
        action: The actions ``(*batch, d)``, finite.
        depth: The share of the way from the point of `reach` to the boundary that is left.
    """
    origin, share = reach(bijector, action)
    kept = ((1 - depth) * share).clamp(max=1).unsqueeze(-1)
    return torch.where(kept < 1, origin + kept * (action - origin), action)


def _bisected(bijector: Bijector, origin: Tensor, offset: Tensor) -> Tensor:
    """Return the share of an offset that remains in the image, up to twice the offset."""
    low = torch.zeros_like(offset[..., 0])
    high = torch.full_like(low, 2.0)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        inside = bijector.contains(origin + middle.unsqueeze(-1) * offset)
        low, high = torch.where(inside, middle, low), torch.where(inside, high, middle)
    return low
