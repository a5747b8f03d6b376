"""Checks of gauges: their values, their accuracy in float32, and their gradients."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.geometry import ConstraintSet
from cnfp_torchrl.testing.example import DTYPES, Example
from cnfp_torchrl.testing.family_error import require

_SHORTEST = 2.0**-40
"""The shortest direction that a flow asks the gauge of, as a share of the ray to the bounds."""


def check_gauge_is_where_rays_leave(example: Example) -> None:
    """A ray is inside up to ``anchor + direction / gauge``, has no slack there, then is outside."""
    sets = example.sets
    for rays in example.rays:
        gauge = sets.gauge(rays.directions, rays.anchor)
        at = {"direction": rays.directions, "anchor": rays.anchor}
        require(sets, "gauge", gauge.isfinite() & (gauge >= 0), "a number >= 0", "it", gauge, **at)
        # Exits beyond twice the ray to the bounds do not count.
        leaves = gauge > 0.5
        end = rays.ends(gauge.clamp(min=0.5)) - rays.anchor
        first = torch.full_like(gauge, torch.inf)
        for share in (1 - 1e-7, *torch.linspace(1, 0, 17).tolist()[1:]):
            first = torch.where(sets.contains(rays.anchor + end * share), first, share)
        expected = "all before anchor + direction / gauge inside"
        quantity = "one outside, at this share of the ray:"
        require(sets, "gauge", first.isinf(), expected, quantity, first, **at)
        outside = ~leaves | ~sets.contains(rays.anchor + end * (1 + 1e-7))
        expected = "what follows on anchor + direction / gauge outside"
        require(sets, "gauge", outside, expected, "it inside, for a gauge of", gauge, **at)
        slack = sets.slack(rays.anchor + end)
        no_slack = ~leaves | (slack.abs() <= 1e-7 * example.size)
        expected = "0 at anchor + direction / gauge, where contains changes"
        require(sets, "slack", no_slack, expected, "a slack of", slack, **at)


def check_gauge_is_homogeneous(example: Example) -> None:
    """``gauge(t v) = t gauge(v)`` for t > 0, also where t v is short."""
    for dtype in DTYPES:
        sets = example.cast(dtype)[1]
        for rays in (drawn.cast(dtype) for drawn in example.rays):
            gauge = sets.gauge(rays.directions, rays.anchor)
            for scale in (_SHORTEST, 2.0**-12, 2.0**10):
                ratio = sets.gauge(rays.directions * scale, rays.anchor) / (scale * gauge)
                # Exits far beyond the bounds need no digits.
                holds = ((ratio - 1).abs() < 1e-3) | (gauge < 1e-2)
                expected = f"{scale:.3g} times the gauge for {scale:.3g} times the direction"
                at = {"direction": rays.directions, "anchor": rays.anchor}
                require(sets, "gauge", holds, expected, "that times", ratio, **at)


def check_gauge_about(example: Example) -> None:
    """`gauge_about` gives what `gauge` gives."""
    for dtype in DTYPES:
        sets = example.cast(dtype)[1]
        for rays in (drawn.cast(dtype) for drawn in example.rays):
            gauge, about = sets.gauge(rays.directions, rays.anchor), sets.gauge_about(rays.anchor)
            error = (about(rays.directions) - gauge).abs()
            same = error <= 1e-4 * gauge + 1e-6
            at = {"direction": rays.directions, "anchor": rays.anchor}
            require(sets, "gauge_about", same, "what gauge gives", "an error of", error, **at)


def check_gauge_in_float32(example: Example) -> None:
    """The exit by the float32 gauge misses the boundary by less than `eroded` takes away.

    Judged by the slack of the exit, not by the gauge's digits, which are unknown to any arithmetic
    where a ray grazes the boundary.
    """
    wide = example.sets
    sets = example.cast(torch.float32)[1]
    eroded = sets.eroded(example.size.float()).to(torch.float64)
    for rays in example.rays:
        single = rays.cast(torch.float32)
        gauge = sets.gauge(single.directions, single.anchor).double()
        at = {"direction": rays.directions, "anchor": rays.anchor}
        require(sets, "gauge", gauge.isfinite() & (gauge >= 0), "a number >= 0", "it", gauge, **at)
        margin = wide.slack(rays.ends(eroded.gauge(rays.directions, rays.anchor).clamp(min=1)))
        slack = wide.slack(rays.ends(gauge.clamp(min=1)))
        most = "than eroded leaves for rounding errors (does it subtract large numbers?)"
        holds = slack >= -margin
        expected = f"a float32 exit no further outside {most}"
        require(sets, "gauge", holds, expected, "this many times that,", -slack / margin, **at)
        holds = (slack <= margin) | (gauge <= 1)
        expected = f"a float32 exit no further inside {most}"
        require(sets, "gauge", holds, expected, "this many times that,", slack / margin, **at)


def check_gauge_gradient_is_finite(example: Example) -> None:
    """Gradients in direction and anchor are finite, also at kinks and in short directions."""
    for dtype in DTYPES:
        sets = example.cast(dtype)[1]
        for rays in (drawn.cast(dtype) for drawn in example.rays):
            for scale in (1.0, _SHORTEST):
                directions = (scale * rays.directions).requires_grad_()
                anchor = rays.anchor.expand(directions.shape).clone().requires_grad_()
                inputs, gauge = (directions, anchor), sets.gauge(directions, anchor)
                gradients = torch.autograd.grad(gauge.sum(), inputs, allow_unused=True)
                for name, gradient in zip(("direction", "anchor"), gradients, strict=True):
                    if gradient is None:
                        continue
                    total = gradient.sum(-1)
                    expected = f"a finite gradient in the {name}"
                    at = {"direction": directions.detach(), "anchor": rays.anchor}
                    require(
                        sets, "gauge", total.isfinite(), expected, "a sum of it of", total, **at
                    )


def check_gauge_gradient(example: Example) -> None:
    """Gradients in direction and anchor equal finite differences in float64, where smooth."""
    sets = example.sets
    for rays in example.rays:
        # Moved off the axes and diagonals, where kinks are likely.
        directions = rays.directions * (1 + 0.1 * example.normal(*rays.directions.shape))
        length = vector_norm(directions, dim=-1, keepdim=True)
        directions = directions + 0.01 * length * example.normal(*directions.shape)
        anchor = rays.anchor.expand(directions.shape)
        # In shares of the slack, so that a step of the anchor stays well inside.
        room = sets.slack(rays.anchor).minimum(example.size).expand(directions.shape[:-1])
        sizes = {"direction": vector_norm(directions, dim=-1), "anchor": room}
        for name, size in sizes.items():
            along = example.normal(*directions.shape)
            along = along * (1e-4 * size / vector_norm(along, dim=-1)).unsqueeze(-1)
            move = (along, 0.0) if name == "direction" else (0.0, along)
            back, value, ahead = (
                sets.gauge(directions + s * move[0], anchor + s * move[1]) for s in (-1, 0, 1)
            )
            slope = _slope(sets, name, directions, anchor, along)
            behind, before = value - back, ahead - value
            larger = torch.maximum(behind.abs(), before.abs())
            # Differences on both sides agree where there is no kink between.
            smooth = (behind - before).abs() <= 0.02 * larger
            error = (slope - (behind + before) / 2).abs()
            holds = ~smooth | (error <= 0.02 * larger + 1e-9 * value)
            expected = f"the gradient in the {name} that finite differences show"
            at = {"direction": directions, "anchor": anchor, "along": along}
            require(sets, "gauge", holds, expected, "a relative error of", error / larger, **at)


def _slope(
    sets: ConstraintSet, name: str, directions: Tensor, anchor: Tensor, along: Tensor
) -> Tensor:
    """Return the derivative of the gauge along a change of one argument, by autograd."""
    at = (directions if name == "direction" else anchor).clone().requires_grad_()
    gauge = sets.gauge(at, anchor) if name == "direction" else sets.gauge(directions, at)
    (gradient,) = torch.autograd.grad(gauge.sum(), at)
    return (gradient * along).sum(-1)
