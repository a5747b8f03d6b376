"""Checks of what flows need: erosion, log-determinants, and sets that replace dropped ones."""

from __future__ import annotations

import torch
from torch.linalg import slogdet, vector_norm

from cnfp_torchrl.bijectors import GaugeSquash
from cnfp_torchrl.geometry import ConstraintSet, Region
from cnfp_torchrl.testing.example import DTYPES, Example
from cnfp_torchrl.testing.family_error import require

ROUNDING_IN_EPS = 2.0
"""The least rounding error of a flow's action, in units of that of anchor and action."""

LARGEST_EROSION_IN_EPS = 1e4
"""The most that `eroded` may take away, in units of rounding error of the largest action."""


def check_erosion_covers_rounding(example: Example) -> None:
    """Actions at the eroded boundary, moved outwards by rounding errors, lie in the set."""
    # Erosion of float32, not of float64, whose rounding errors its own gauges have too.
    eps = ROUNDING_IN_EPS * torch.finfo(torch.float32).eps
    sets = example.cast(torch.float32)[1]
    eroded = sets.eroded(example.size.float()).to(torch.float64)
    for rays in example.rays:
        gauge = eroded.gauge(rays.directions, rays.anchor)
        action = rays.ends(gauge.clamp(min=1)).requires_grad_()
        (uphill,) = torch.autograd.grad(example.sets.slack(action).sum(), action)
        action = action.detach()
        moved = action - uphill.sign() * eps * (action.abs() + rays.anchor.abs())
        holds = example.sets.contains(moved) | (gauge < 1)
        slack = example.sets.slack(action)
        expected = "room for rounding errors of all numbers that enter"
        at = {"direction": rays.directions, "anchor": rays.anchor, "action": action}
        require(sets, "eroded", holds, expected, "at the eroded boundary a slack of", slack, **at)


def check_erosion_is_small(example: Example) -> None:
    """Erosion takes away no more than `LARGEST_EROSION_IN_EPS` rounding errors of the actions."""
    for dtype in DTYPES:
        sets = example.cast(dtype)[1]
        eroded = sets.eroded(example.size.to(dtype)).to(torch.float64)
        most = LARGEST_EROSION_IN_EPS * torch.finfo(dtype).eps * example.size
        for rays in example.rays:
            gauge = eroded.gauge(rays.directions, rays.anchor)
            depth = example.sets.slack(rays.ends(gauge.clamp(min=1)))
            holds = (depth <= most) | (gauge < 1)
            expected = f"rounding errors taken away, {float(most.amin()):.3g} at most"
            at = {"direction": rays.directions, "anchor": rays.anchor}
            require(sets, "eroded", holds, expected, "a depth of", depth, **at)


def check_flow_stays_inside(example: Example) -> None:
    """Saturated samples of an exact flow lie in the set, with zero tolerance."""
    for dtype in DTYPES:
        bounds, sets = example.cast(dtype)
        for rays in (drawn.cast(dtype) for drawn in example.rays):
            region = Region((bounds, sets), rays.anchor)
            inner = region.eroded()
            gauge = inner.outer_and_inner_gauge(rays.directions)[1]
            flow = GaugeSquash(region)
            latents = example.directions(len(rays.directions)).to(dtype)
            latents = latents / vector_norm(latents, dim=-1, keepdim=True)
            actions = [rays.ends(gauge), *(flow(length * latents) for length in (1.0, 20.0, 1e6))]
            action = torch.cat(actions)
            slack = example.sets.slack(action.double())
            expected = "actions of a flow into the eroded set to lie in the set"
            at = {"action": action, "anchor": rays.anchor}
            require(sets, "eroded", sets.contains(action), expected, "a slack of", slack, **at)


def check_log_det(example: Example) -> None:
    """A flow's log-determinant, derived from the gauge's homogeneity, equals autograd's."""
    rays = example.rays[0]
    flow = GaugeSquash(Region((example.bounds, example.sets), rays.anchor))
    latent = example.normal(8, *rays.anchor.shape).requires_grad_()
    action, log_det = flow.forward_and_log_det(latent)
    rows = [
        torch.autograd.grad(action[..., i].sum(), latent, retain_graph=True)[0]
        for i in range(action.shape[-1])
    ]
    error = (slogdet(torch.stack(rows, -2)).logabsdet - log_det).abs().detach()
    expected = "a homogeneous gauge with its gradient, so that log-determinants are right"
    at = {"latent": latent.detach(), "anchor": rays.anchor}
    require(example.sets, "gauge", error < 1e-6, expected, "an error of", error, **at)


def check_around_contains_the_ball(example: Example) -> None:
    """`around` contains its ball, wherever that is, with finite gauges about the ball's center."""
    for dtype in DTYPES:
        sets = example.cast(dtype)[1]
        inside = example.rays[0].anchor
        for offset in example.rays_from(inside, example.directions(5)).directions:
            center = (inside + 2 * offset).to(dtype)
            radius = (0.5 + 4 * example.uniform(len(center))).to(dtype) * example.size.to(dtype)
            around = sets.around(center, radius)
            directions = example.directions(50).to(dtype)
            directions = directions / vector_norm(directions, dim=-1, keepdim=True)
            action = center + directions * (radius * (1 - 1e-5)).unsqueeze(-1)
            at = {"ball_center": center, "action": action}
            expected = "the whole ball inside"
            require(
                sets, "around", around.contains(action), expected, "one of radius", radius, **at
            )
            directions.requires_grad_()
            gauge = around.gauge(directions, center)
            (gradient,) = torch.autograd.grad(gauge.sum(), directions)
            finite = gauge.isfinite() & gradient.isfinite().all(-1)
            expected = "finite gauges with finite gradients about the ball's center"
            require(sets, "around", finite, expected, "a gauge of", gauge.detach(), **at)


def check_dropped_sets_do_not_bind(example: Example) -> None:
    """Where a set is dropped the flow is that of the action bounds, wherever the set lies."""
    own = type(example.sets).unless_dropped is not ConstraintSet.unless_dropped
    method = "unless_dropped" if own else "around"
    for dtype in DTYPES:
        bounds, sets = example.cast(dtype)
        inside = example.rays[0].anchor
        elsewhere = inside + 0.9 * example.rays_from(inside, example.directions(1)).directions[0]
        dropped = torch.arange(len(inside), device=inside.device) % 2 == 0
        anchor = torch.where(dropped.unsqueeze(-1), elsewhere, inside).to(dtype)
        active = torch.stack([torch.ones_like(dropped), ~dropped], -1)
        latent = example.normal(len(example.rays[0].directions), *inside.shape).to(dtype)
        latent.requires_grad_()
        flow = GaugeSquash(Region((bounds, sets), anchor, active))
        action, log_det = flow.forward_and_log_det(latent)
        (gradient,) = torch.autograd.grad(action.sum() + log_det.sum(), latent)
        free = GaugeSquash(Region((bounds,), anchor)).forward_and_log_det(latent)[0]
        error = (action - free).abs().amax(-1).detach()
        tolerance = 1e2 * torch.finfo(dtype).eps * example.size
        holds = ~dropped | (error <= tolerance) & log_det.isfinite()
        at = {"latent": latent.detach(), "anchor": anchor}
        expected = "no influence of a dropped set"
        require(sets, method, holds, expected, "an action off by", error, **at)
        finite = gradient.isfinite().all(-1) | ~dropped
        expected = "a finite gradient of the flow where sets are dropped"
        require(sets, method, finite, expected, "a gradient of", gradient.sum(-1), **at)
        kept = sets.contains(action.detach()) | dropped
        expected = "active sets of a batch with dropped ones to hold"
        slack = sets.slack(action.detach())
        require(sets, method, kept, expected, "a slack of", slack, **at)
