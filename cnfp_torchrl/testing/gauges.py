"""Checks of gauges: that they are right, accurate in float32, and have gradients."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.geometry import ConstraintSet
from cnfp_torchrl.testing.example import DTYPES, Example
from cnfp_torchrl.testing.family_error import require

_SHORTEST = 2.0**-40
"""How short a way may be, as a share of that to the bounds, for a flow to ask for its gauge."""


def check_gauge_is_where_rays_leave(example: Example) -> None:
    """``anchor + way / gauge`` has no slack, all before it is inside, what follows is outside."""
    sets = example.sets
    for view in example.views:
        gauge = sets.gauge(view.ways, view.anchor)
        at = {"direction": view.ways, "anchor": view.anchor}
        require(sets, "gauge", gauge.isfinite() & (gauge >= 0), "a number >= 0", "it", gauge, **at)
        # Beyond twice the way to the bounds nothing matters.
        leaves = gauge > 0.5
        end = view.at(gauge.clamp(min=0.5)) - view.anchor
        first = torch.full_like(gauge, torch.inf)
        for share in (1 - 1e-7, *torch.linspace(1, 0, 17).tolist()[1:]):
            first = torch.where(sets.contains(view.anchor + end * share), first, share)
        expected = "all before anchor + direction / gauge inside"
        quantity = "one outside at a share of the way of"
        require(sets, "gauge", first.isinf(), expected, quantity, first, **at)
        outside = ~leaves | ~sets.contains(view.anchor + end * (1 + 1e-7))
        expected = "what follows on anchor + direction / gauge outside"
        require(sets, "gauge", outside, expected, "it inside, for a gauge of", gauge, **at)
        slack = sets.slack(view.anchor + end)
        no_slack = ~leaves | (slack.abs() <= 1e-7 * example.size)
        expected = "0 at anchor + direction / gauge, where contains changes"
        require(sets, "slack", no_slack, expected, "a slack of", slack, **at)


def check_gauge_is_homogeneous(example: Example) -> None:
    """``gauge(t v) = t gauge(v)`` for t > 0, for short ways too."""
    for dtype in DTYPES:
        sets = example.cast(dtype)[1]
        for view in (each.cast(dtype) for each in example.views):
            gauge = sets.gauge(view.ways, view.anchor)
            for scale in (_SHORTEST, 2.0**-12, 2.0**10):
                ratio = sets.gauge(view.ways * scale, view.anchor) / (scale * gauge)
                # Where the set ends far beyond the bounds the digits do not count.
                holds = ((ratio - 1).abs() < 1e-3) | (gauge < 1e-2)
                expected = f"{scale:.3g} times the gauge for {scale:.3g} times the direction"
                at = {"direction": view.ways, "anchor": view.anchor}
                require(sets, "gauge", holds, expected, "that times", ratio, **at)


def check_gauge_about(example: Example) -> None:
    """`gauge_about` gives what `gauge` gives."""
    for dtype in DTYPES:
        sets = example.cast(dtype)[1]
        for view in (each.cast(dtype) for each in example.views):
            gauge, about = sets.gauge(view.ways, view.anchor), sets.gauge_about(view.anchor)
            error = (about(view.ways) - gauge).abs()
            same = error <= 1e-4 * gauge + 1e-6
            at = {"direction": view.ways, "anchor": view.anchor}
            require(sets, "gauge_about", same, "what gauge gives", "an error of", error, **at)


def check_gauge_in_float32(example: Example) -> None:
    """The float32 gauge misses the boundary by less than what `eroded` leaves for rounding.

    Judged by the slack of the exit, not by the gauge's digits: a ray that grazes the boundary has
    an exit that no arithmetic knows well.
    """
    wide = example.sets
    sets = example.cast(torch.float32)[1]
    eroded = sets.eroded(example.size.float()).to(torch.float64)
    for view in example.views:
        single = view.cast(torch.float32)
        gauge = sets.gauge(single.ways, single.anchor).double()
        at = {"direction": view.ways, "anchor": view.anchor}
        require(sets, "gauge", gauge.isfinite() & (gauge >= 0), "a number >= 0", "it", gauge, **at)
        margin = wide.slack(view.at(eroded.gauge(view.ways, view.anchor).clamp(min=1)))
        slack = wide.slack(view.at(gauge.clamp(min=1)))
        words = "than eroded leaves for rounding errors (does it subtract large numbers?)"
        holds = slack >= -margin
        expected = f"a float32 exit no further outside {words}"
        require(sets, "gauge", holds, expected, "this many times that,", -slack / margin, **at)
        holds = (slack <= margin) | (gauge <= 1)
        expected = f"a float32 exit no further inside {words}"
        require(sets, "gauge", holds, expected, "this many times that,", slack / margin, **at)


def check_gauge_gradient_is_finite(example: Example) -> None:
    """Gradients in direction and anchor are finite, at kinks and for short ways too."""
    for dtype in DTYPES:
        sets = example.cast(dtype)[1]
        for view in (each.cast(dtype) for each in example.views):
            for scale in (1.0, _SHORTEST):
                ways, anchor = (
                    each.expand(view.ways.shape).clone().requires_grad_()
                    for each in (view.ways * scale, view.anchor)
                )
                gauge = sets.gauge(ways, anchor)
                gradients = torch.autograd.grad(gauge.sum(), (ways, anchor), allow_unused=True)
                for name, gradient in zip(("direction", "anchor"), gradients, strict=True):
                    if gradient is None:
                        continue
                    total = gradient.sum(-1)
                    expected = f"a finite gradient in the {name}"
                    at = {"direction": ways.detach(), "anchor": view.anchor}
                    require(
                        sets, "gauge", total.isfinite(), expected, "a sum of it of", total, **at
                    )


def check_gauge_gradient(example: Example) -> None:
    """In float64 gradients in direction and anchor equal finite differences, where smooth."""
    sets = example.sets
    for view in example.views:
        # Off the axes and other directions at which kinks are likely.
        ways = view.ways * (1 + 0.1 * example.normal(*view.ways.shape))
        ways = ways + 0.01 * vector_norm(ways, dim=-1, keepdim=True) * example.normal(*ways.shape)
        anchor = view.anchor.expand(ways.shape)
        # A step from the anchor must stay well inside.
        room = sets.slack(view.anchor).minimum(example.size)
        steps = {"direction": vector_norm(ways, dim=-1), "anchor": room.expand(ways.shape[:-1])}
        for name, size in steps.items():
            along = example.normal(*ways.shape)
            along = along * (1e-4 * size / vector_norm(along, dim=-1)).unsqueeze(-1)
            move = (along, 0.0) if name == "direction" else (0.0, along)
            back, value, ahead = (
                sets.gauge(ways + s * move[0], anchor + s * move[1]) for s in (-1, 0, 1)
            )
            slope = _slope(sets, name, ways, anchor, along)
            behind, before = value - back, ahead - value
            larger = torch.maximum(behind.abs(), before.abs())
            # Where both sides agree there is no kink between.
            smooth = (behind - before).abs() <= 0.02 * larger
            error = (slope - (behind + before) / 2).abs()
            holds = ~smooth | (error <= 0.02 * larger + 1e-9 * value)
            expected = f"the gradient in the {name} that finite differences show"
            at = {"direction": ways, "anchor": anchor, "along": along}
            require(sets, "gauge", holds, expected, "a relative error of", error / larger, **at)


def _slope(sets: ConstraintSet, name: str, ways: Tensor, anchor: Tensor, along: Tensor) -> Tensor:
    """Return the directional derivative of the gauge by its gradient."""
    at = (ways if name == "direction" else anchor).clone().requires_grad_()
    gauge = sets.gauge(at, anchor) if name == "direction" else sets.gauge(ways, at)
    (gradient,) = torch.autograd.grad(gauge.sum(), at)
    return (gradient * along).sum(-1)
