"""What a flow does to wished actions that are allowed already, which it should leave alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.linalg import svdvals, vector_norm

from cnfp_torchrl.audit.statistics import Quantiles, Share, quantiles
from cnfp_torchrl.bijectors import BoxSquash
from cnfp_torchrl.geometry import Region
from cnfp_torchrl.modules import Flow, RecessionFlow

Map = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Distortion:
    """Measurements of a flow on actions of the allowed region, and on samples.

    A flow makes an action a of a wished action x of the action bounds. One that leaves the allowed
    alone has a = x there, and all singular values of da/dx are 1.

    Args:
        moved: Quantiles of how far allowed actions move, as a share of the way from the anchor to
            the boundary on their ray.
        smallest: Quantiles of the smallest singular value of da/dx at allowed actions.
        largest: Quantiles of the largest one.
        on_boundary: The share of the float32 actions of standard normal latents that lie on the
            region's boundary up to rounding, where many latents share one action.
    """

    moved: Quantiles
    smallest: Quantiles
    largest: Quantiles
    on_boundary: Share


def measure_distortion(flow: Flow, region: Region, samples: int) -> Distortion:
    """Return the distortion of a safe flow, over random actions of some regions.

    Args:
        flow: The flow.
        region: Regions of batch shape ``(n,)``, with finite bounds and an anchor.
        samples: The number of actions in each region.
    """
    exact = region.to(torch.float64)
    wished = allowed_actions(exact, samples)
    shape = (samples, *region.shape)
    with torch.enable_grad():
        point = wished.requires_grad_()
        action = map_of_wishes(flow, exact)(point)
        rows = [
            torch.autograd.grad(action[..., i].sum(), point, retain_graph=True)[0]
            for i in range(action.shape[-1])
        ]
    jacobian, point, action = torch.stack(rows, -2), point.detach(), action.detach()
    values = svdvals(jacobian)
    ray = point - exact.anchor
    reach = vector_norm(ray, dim=-1) / exact.gauges(ray)[-1]
    single = region.to(torch.float32)
    drawn = flow(single)(torch.randn(shape, dtype=torch.float32))
    on_boundary = is_on_boundary(single, drawn).reshape(samples, -1).sum(0)
    return Distortion(
        quantiles(vector_norm(action - point, dim=-1) / reach),
        quantiles(values[..., -1]),
        quantiles(values[..., 0]),
        Share.clustered(on_boundary, torch.full_like(on_boundary, samples)),
    )


def map_of_wishes(flow: Flow, region: Region) -> Map:
    """Return the map from wished actions in the bounds to actions: the flow without stage 0.

    Args:
        flow: The flow.
        region: Regions, or a flow's region with finite bounds.
    """
    if isinstance(flow, RecessionFlow):
        return flow.of_actions(region)
    bijector, squash = flow(region), BoxSquash(region.bounds.low, region.bounds.high)
    return lambda wished: bijector(squash.inverse_and_log_det(wished)[0])


def allowed_actions(region: Region, samples: int) -> Tensor:
    """Return random actions of a region, ``(samples, *batch, d)``, up to 0.999 of each ray."""
    anchor = region.anchor
    direction = torch.randn(samples, *region.shape, dtype=anchor.dtype, device=anchor.device)
    share = torch.rand_like(direction[..., 0]) ** (1 / region.shape[-1])
    gauge = region.gauges(direction)[-1]
    return anchor + direction * (0.999 * share / gauge).unsqueeze(-1)


def is_on_boundary(region: Region, action: Tensor) -> Tensor:
    """Tell which actions are as near to the boundary, eroded or not, as rounding resolves."""
    eps = torch.finfo(action.dtype).eps
    eroded = region.eroded()
    offset = action - eroded.anchor
    size = (action.abs() + eroded.anchor.abs()).amax(-1)
    rest = (1 - eroded.gauges(offset)[-1]) * vector_norm(offset, dim=-1)
    return rest <= 2 * eps * size
