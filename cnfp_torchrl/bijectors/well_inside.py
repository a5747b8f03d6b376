"""Given actions, moved to where a bijector's densities are finite."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.bijectors.bijector import Bijector

_HALVINGS = 30


def reach(bijector: Bijector, action: Tensor) -> tuple[Tensor, Tensor]:
    """Return an origin in the image, and how far the image reaches from it towards actions.

    The origin is the anchor of the bijector's region, or the action of latent 0 if it has none. The
    images of this package's bijectors are star-shaped about it.

    Args:
        bijector: The bijector with the image.
        action: Actions ``(*batch, d)``, finite, inside the image or outside.

    Returns:
        The origin ``(*batch, d)``, and the share ``(*batch,)`` of the line from it to the action
        that lies in the image, below 1 if the action is outside.
    """
    region = getattr(bijector, "region", None)
    if region is None:
        origin = bijector(torch.zeros_like(action))
        return origin, _bisected(bijector, origin, action - origin)
    offset = action - region.anchor
    length = vector_norm(offset, dim=-1)
    # The gauge of a unit vector, times the length, not of the offset, which may overflow.
    unit = offset / torch.where(length > 0, length, 1).unsqueeze(-1)
    gauge = region.outer_and_inner_gauge(unit)[1] * length
    return region.anchor.expand_as(action), gauge.reciprocal()


def well_inside(bijector: Bijector, action: Tensor, depth: float) -> Tensor:
    """Return actions pulled towards the origin of `reach`, if they are too near the boundary.

    Args:
        bijector: The bijector whose image the actions are pulled into.
        action: Actions ``(*batch, d)``, finite.
        depth: The share of the ray from the origin to the boundary that is left ahead of an action.
    """
    origin, share = reach(bijector, action)
    kept = ((1 - depth) * share).clamp(max=1).unsqueeze(-1)
    return torch.where(kept < 1, origin + kept * (action - origin), action)


def _bisected(bijector: Bijector, origin: Tensor, offset: Tensor) -> Tensor:
    """Return the share of an offset that lies in the image, at most 2, by bisection."""
    low = torch.zeros_like(offset[..., 0])
    high = torch.full_like(low, 2.0)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        inside = bijector.contains(origin + middle.unsqueeze(-1) * offset)
        low, high = torch.where(inside, middle, low), torch.where(inside, high, middle)
    return low
