"""Checks of slack and containment, and of what the search for anchors knows of a family."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.geometry import (
    Bounds,
    Box,
    Cone,
    KinkedSum,
    Rows,
    Superlevel,
    lexicographic_anchor,
    row_depths,
)
from cnfp_torchrl.testing.example import Example
from cnfp_torchrl.testing.family_error import FamilyError, called, require

_COUNT = 200


def check_slack_at_the_anchor(example: Example) -> None:
    """The given anchor has a positive slack and is in the set."""
    anchor = example.rays[0].anchor
    slack = example.sets.slack(anchor)
    expected = "a positive slack at the given anchor (or an anchor inside the set)"
    require(example.sets, "slack", slack > 0, expected, "a slack of", slack, anchor=anchor)
    inside = example.sets.contains(anchor)
    expected = "the given anchor inside"
    require(example.sets, "contains", inside, expected, "a slack of", slack, anchor=anchor)


def check_contains_agrees_with_slack(example: Example) -> None:
    """`contains` is true where the slack is positive, false where it is negative."""
    action = example.actions(5 * _COUNT)
    slack = example.sets.slack(action)
    require(example.sets, "slack", ~slack.isnan(), "a number", "it", slack, action=action)
    inside = example.sets.contains(action)
    agrees = ((slack > 0) == inside) | (slack.abs() <= 1e-9 * example.size)
    expected = "actions inside where their slack is positive, and only there"
    require(example.sets, "contains", agrees, expected, "a slack of", slack, action=action)


def check_slack_bounds_the_distance(example: Example) -> None:
    """Actions nearer to each other than the slack of one are both inside or both outside."""
    action = example.actions(_COUNT).requires_grad_()
    slack = example.sets.slack(action)
    (uphill,) = torch.autograd.grad(slack.nan_to_num().sum(), action)
    action, slack = action.detach(), slack.detach()
    reach = slack.abs().minimum(1e3 * example.size) * (1 - 1e-6)
    uphill = uphill.nan_to_num()
    for direction in (uphill, -uphill, *example.directions(8)):
        length = vector_norm(direction, dim=-1, keepdim=True)
        near = action + direction / torch.where(length > 0, length, 1.0) * reach.unsqueeze(-1)
        same = example.sets.contains(near) == (slack > 0)
        require(
            example.sets,
            "slack",
            same | (slack.abs() <= 1e-9 * example.size),
            "the distance to the boundary or less, as nothing nearer than it is on the other side",
            "a slack of",
            slack,
            action=action,
            other_side=near,
        )


def check_rows(example: Example) -> None:
    """The smallest of `row_slacks` is the slack."""
    action = example.actions(_COUNT)
    slack, least = example.sets.slack(action), example.sets.row_slacks(action).amin(-1)
    same = (slack == least) | ((slack - least).abs() <= _tolerance(example, slack))
    expected = "rows of which the smallest slack is the set's"
    require(example.sets, "row_slacks", same, expected, "a smallest of", least, action=action)


def check_inflated(example: Example) -> None:
    """`inflated` holds the actions with a slack of at least ``-by`` in every row, and no others."""
    sets = example.sets
    if not sets.can_be_inflated():
        return
    action = example.actions(_COUNT)
    slacks = sets.row_slacks(action)
    one = example.size.unsqueeze(-1)
    for by in (
        one * example.uniform(*slacks.shape[1:]),
        one * example.uniform(*one.shape),
        0 * one,
    ):
        wider = called(type(sets), "inflated", partial(sets.inflated, by))
        room = (slacks + by).amin(-1)
        agrees = (room.abs() <= _tolerance(example, room)) | (wider.contains(action) == (room > 0))
        expected = "all actions with a slack of at least -by in every row, and no others"
        require(sets, "inflated", agrees, expected, "slack + by of", room, action=action, by=by)


def check_slack_is_concave(example: Example) -> None:
    """The slack is concave, and its gradient says so, unless `superlevel` is stated instead."""
    sets = example.sets
    if sets.superlevel() is not None:
        return
    holds, slack, chord, one, other = _chords(example)
    require(
        sets,
        "slack",
        holds,
        "a concave function, at least the chord's value between two actions; otherwise the search "
        "for anchors drops sets that hold (if the set is not convex, state superlevel and "
        "part_near)",
        "a difference of",
        slack - chord,
        one_action=one,
        other_action=other,
    )
    at = torch.cat([one, example.rays[0].anchor.unsqueeze(0)]).requires_grad_()
    value = sets.slack(at)
    (gradient,) = torch.autograd.grad(value.sum(), at)
    ahead = torch.cat([other, example.actions(1)]) - at.detach()
    linear = value.detach() + (gradient * ahead).sum(-1)
    excess = sets.slack(at.detach() + ahead) - linear
    require(
        sets,
        "slack",
        excess <= _tolerance(example, value.detach()),
        "a finite gradient whose linearization lies above the slack everywhere",
        "a slack that exceeds it by",
        excess,
        action=at.detach(),
        gradient=gradient,
        exceeded_at=at.detach() + ahead,
    )


def check_superlevel(example: Example) -> None:
    """Parts described by `superlevel` and `part_near` lie in the set and have its slack."""
    sets = example.sets
    part = called(type(sets), "superlevel", sets.superlevel)
    if part is None:
        return
    action = example.actions(5 * _COUNT)
    slack = sets.slack(action)
    level = _check_part(example, "superlevel", part, action)
    if sets.is_convex():
        complete = (slack <= 0) | (level >= slack - _tolerance(example, slack))
        expected = "all actions with a slack of t described (if not convex, by part_near)"
        require(
            sets, "superlevel", complete, expected, "a difference of", level - slack, action=action
        )
        return
    for point in action[:5]:
        part = called(type(sets), "part_near", partial(sets.part_near, point))
        level = _check_part(example, "part_near", part, torch.cat([point.unsqueeze(0), action]))[0]
        slack = sets.slack(point)
        complete = (slack <= 0) | (level >= slack - _tolerance(example, slack))
        expected = "as much slack at the point in the part as in the set"
        require(
            sets, "part_near", complete, expected, "a difference of", level - slack, point=point
        )


def _check_part(example: Example, method: str, part: object, action: Tensor) -> Tensor:
    """Check that a part promises no more slack than the set has; return what it promises."""
    family, slack = type(example.sets), example.sets.slack(action)
    if not isinstance(part, Rows | Cone | KinkedSum):
        raise FamilyError(family, method, f"expected Rows, a Cone or a KinkedSum, given {part!r}")
    level = called(family, method, partial(_level, part, action))
    holds = (level <= 0) | (slack >= level - _tolerance(example, slack))
    expected = "actions described as having a slack of t to have it"
    require(example.sets, method, holds, expected, "a difference of", slack - level, action=action)
    return level


def check_search_keeps_the_set(example: Example) -> None:
    """The search for anchors keeps the set wherever the given anchor has slack enough."""
    sets, bounds, anchor = example.sets, example.bounds, example.rays[0].anchor
    method = "slack" if sets.superlevel() is None else "superlevel"
    depths = row_depths([bounds, sets])
    rooms = [
        (constraint_set.row_slacks(anchor) - 2 * depth).amin(-1)
        for constraint_set, depth in zip((bounds, sets), depths, strict=True)
    ]
    slack = torch.minimum(*rooms)
    found = called(type(sets), method, lambda: lexicographic_anchor([bounds, sets]))
    kept = found.active[..., 1] | (slack < 0)
    expected = "the search for anchors to keep the set wherever an anchor has slack enough"
    require(sets, method, kept, expected, "a slack of", slack, anchor=anchor)


def check_bounding_box(example: Example) -> None:
    """The bounding box holds what the set contains."""
    box = Box(*example.sets.bounding_box(), validate_args=False)
    points = [example.actions(5 * _COUNT)]
    for rays in example.rays:
        points.append(rays.ends(example.sets.gauge(rays.directions, rays.anchor).clamp(min=1)))
    action = torch.cat(points)
    outside = example.sets.slack(action) < 0
    slack = box.slack(action)
    holds = outside | (slack >= -1e-7 * example.size)
    expected = "every action of the set in the box"
    require(example.sets, "bounding_box", holds, expected, "a slack in it of", slack, action=action)


def check_deepest_within(example: Example) -> None:
    """The deepest point of a box lies in it, and no other has more slack."""
    one, other = example.actions(_COUNT), example.actions(_COUNT).flip(0)
    low, high = torch.minimum(one, other), torch.maximum(one, other)
    method = "deepest_within"
    deepest = called(
        type(example.sets), method, lambda: example.sets.deepest_within(Bounds(low, high))
    )
    if deepest is None:
        return
    room = Box(low, high, validate_args=False).slack(deepest)
    expected = "a point of the box"
    require(example.sets, method, room >= 0, expected, "a slack in it of", room, action=deepest)
    most = example.sets.slack(deepest)
    for share in (0.0, 1.0, example.uniform(*low.shape), example.uniform(*low.shape).round()):
        action = low + (high - low) * share
        slack = example.sets.slack(action)
        holds = slack <= most + _tolerance(example, slack)
        expected = "no point of the box with more slack"
        require(example.sets, method, holds, expected, "a slack of", slack, action=action)


def check_contains_is_exact(example: Example) -> None:
    """`contains` judges float32 actions at the boundary by float64 arithmetic."""
    sets = example.cast(torch.float32)[1]
    for rays in example.rays:
        gauge = example.sets.gauge(rays.directions, rays.anchor).clamp(min=0.25)
        ulps = 4 * (example.uniform(*rays.directions.shape) - 0.5) * torch.finfo(torch.float32).eps
        action = (rays.ends(gauge) * (1 + ulps)).float()
        slack = example.sets.slack(action.double())
        same = sets.contains(action) == example.sets.contains(action.double())
        # Nearer to the boundary float64 itself cannot tell.
        same = same | (slack.abs() <= 1e-13 * example.size)
        expected = "the float32 numbers judged in float64, also at the boundary"
        require(sets, "contains", same, expected, "another answer at slack", slack, action=action)


def _chords(example: Example) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return whether the slack lies above chords, the slack, the chords, and their two ends."""
    one, other = example.actions(_COUNT), example.actions(_COUNT).flip(0)
    share = example.uniform(_COUNT, one.shape[1])
    at_one, at_other = example.sets.slack(one), example.sets.slack(other)
    between = example.sets.slack(one + (other - one) * share.unsqueeze(-1))
    chord = torch.where(at_one.isinf(), -torch.inf, at_one + (at_other - at_one) * share)
    return between >= chord - _tolerance(example, chord), between, chord, one, other


def _tolerance(example: Example, slack: Tensor) -> Tensor:
    """Return the largest rounding error of a slack, of the example's numbers and arithmetic."""
    return 1e-7 * (example.size + slack.abs().nan_to_num(posinf=0.0))


def _level(part: Superlevel, action: Tensor) -> Tensor:
    """Return the largest t for which a description of {slack >= t} holds an action."""
    match part:
        case Rows(normals, offsets, rates):
            room = offsets - (normals * action.unsqueeze(-2)).sum(-1)
            free = torch.where(room >= 0, torch.inf, -torch.inf)
            return torch.where(rates > 0, room / rates, free).amin(-1)
        case Cone(matrix, vector, size, rate):
            image = (matrix * action.unsqueeze(-2)).sum(-1) + vector
            return (size - vector_norm(image, dim=-1)) / rate
        case KinkedSum(upper, lower, size, rate):
            room = size - torch.maximum(upper * action, lower * action).sum(-1)
            return torch.where(rate > 0, room / rate, torch.where(room >= 0, torch.inf, -torch.inf))
