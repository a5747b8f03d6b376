"""The mathematics of sets and flows written a second time, sharing no code with the package.

Membership in NumPy, on the exact numbers that a policy returned; flows in mpmath, to as many digits
as they need. No gauges here: where a ray leaves a set is found by bisection on membership.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from mpmath import mp, mpf
from numpy.typing import NDArray
from torch import Tensor

from cnfp_torchrl.geometry import (
    Ball,
    Box,
    ConstraintSet,
    Ellipsoid,
    HalfSpaces,
    PositivePart,
    TaskSpaceBall,
    VisibleRegion,
    WeightedL1Ball,
)

# Enough that 1 - tanh(z) is not rounded to 0 where it matters: the flows below add it to numbers of
# size one, and the tests compare to 1e-9.
mp.dps = 34

Vector = list[mpf]


def contains(
    constraint_set: ConstraintSet, action: Tensor, number: type[np.floating] = np.float64
) -> NDArray[np.bool_]:
    """Tell, in NumPy, whether actions lie in a set, on the exact values of all tensors.

    Args:
        constraint_set: The set.
        action: ``(*sample, *batch, d)``.
        number: The type to compute in, longer than the tensors' own: its rounding errors must be
            far below the distance of two neighboring actions.
    """
    a = action.detach().numpy().astype(number)
    fields = {name: value.numpy().astype(number) for name, value in constraint_set.fields().items()}
    match constraint_set:
        case Box():
            return ((fields["low"] <= a) & (a <= fields["high"])).all(-1)
        case Ball():
            return ((a - fields["center"]) ** 2).sum(-1) <= fields["radius"] ** 2
        case Ellipsoid():
            return (_forward_substitution(fields["scale_tril"], a - fields["center"]) ** 2).sum(
                -1
            ) <= 1
        case HalfSpaces():
            return ((fields["normals"] * a[..., None, :]).sum(-1) <= fields["offsets"]).all(-1)
        case WeightedL1Ball():
            return np.abs(fields["weights"] * a).sum(-1) <= fields["bound"]
        case PositivePart():
            return np.maximum(fields["weights"] * a, 0).sum(-1) <= fields["bound"]
        case TaskSpaceBall():
            image = (fields["jacobian"] * a[..., None, :]).sum(-1) + fields["offset"]
            return (image**2).sum(-1) <= fields["radius"] ** 2
        case VisibleRegion():
            return _sees(fields, a)
    raise NotImplementedError(type(constraint_set).__name__)


def _forward_substitution(
    tril: NDArray[np.floating], right: NDArray[np.floating]
) -> NDArray[np.floating]:
    solution = np.zeros(np.broadcast_shapes(right.shape, tril.shape[:-1]), dtype=right.dtype)
    for i in range(tril.shape[-1]):
        known = (tril[..., i, :i] * solution[..., :i]).sum(-1)
        solution[..., i] = (right[..., i] - known) / tril[..., i, i]
    return solution


def _sees(fields: dict[str, NDArray[np.floating]], a: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Tell whether segments miss closed rectangles: one of some directions separates the two.

    For a segment and a rectangle in the plane the axes and the segment's normal suffice.
    """
    start = fields["position"][..., None, :]
    end = start + fields["step"][..., None, None] * a[..., None, :]
    # A thousand is as good as infinite in an arena of size one, and does not make NaN.
    corner = np.clip(fields["rectangles"], -1000, 1000)
    low, high = corner[..., 0, :], corner[..., 1, :]
    beside = (np.maximum(start, end) < low) | (np.minimum(start, end) > high)
    assert a.shape[-1] == 2, "in more dimensions there are more separating directions"
    normal = np.stack([start[..., 1] - end[..., 1], end[..., 0] - start[..., 0]], -1)
    corners = np.stack(
        [
            (normal * (np.stack([x, y], -1) - start)).sum(-1)
            for x in (low[..., 0], high[..., 0])
            for y in (low[..., 1], high[..., 1])
        ]
    )
    across = (corners > 0).all(0) | (corners < 0).all(0)
    return (beside.any(-1) | across).all(-1)


def level(constraint_set: ConstraintSet, action: Vector) -> mpf:
    """Return, in mpmath, a number that is at most 1 exactly on the set, which has no batch."""
    fields = {name: to_mp(value) for name, value in constraint_set.fields().items()}
    match constraint_set:
        case Box():
            pairs = zip(fields["low"], fields["high"], action, strict=True)
            return 1 + max(max(low - a, a - high) for low, high, a in pairs)
        case Ball():
            return distance(action, fields["center"]) / fields["radius"]
        case Ellipsoid():
            return mp.sqrt(
                sum(x**2 for x in whitened(fields["scale_tril"], action, fields["center"]))
            )
        case HalfSpaces():
            rows = zip(fields["normals"], fields["offsets"], strict=True)
            return 1 + max(dot(normal, action) - offset for normal, offset in rows)
        case WeightedL1Ball():
            terms = zip(fields["weights"], action, strict=True)
            return sum((abs(w * a) for w, a in terms), mpf(0)) / fields["bound"]
        case PositivePart():
            terms = zip(fields["weights"], action, strict=True)
            return sum((max(w * a, mpf(0)) for w, a in terms), mpf(0)) / fields["bound"]
        case TaskSpaceBall():
            rows = zip(fields["jacobian"], fields["offset"], strict=True)
            return mp.sqrt(sum((dot(row, action) + b) ** 2 for row, b in rows)) / fields["radius"]
    raise NotImplementedError(type(constraint_set).__name__)


def box_squash(box: Box, latent: Vector) -> tuple[Vector, mpf]:
    low, high = to_mp(box.low), to_mp(box.high)
    action, log_det = [], mpf(0)
    for lower, upper, z in zip(low, high, latent, strict=True):
        action.append(lower + (upper - lower) / (1 + mp.exp(-2 * z)))
        log_det += mp.log((upper - lower) / 2) - 2 * mp.log(mp.cosh(z))
    return action, log_det


def unit_ball_squash(latent: Vector) -> tuple[Vector, mpf]:
    rho = mp.sqrt(sum(z**2 for z in latent))
    if rho == 0:
        return latent, mpf(0)
    share = mp.tanh(rho) / rho
    return [z * share for z in latent], -2 * mp.log(mp.cosh(rho)) + (len(latent) - 1) * mp.log(
        share
    )


def ball_squash(ball: Ball, latent: Vector) -> tuple[Vector, mpf]:
    center, radius = to_mp(ball.center), to_mp(ball.radius)
    point, log_det = unit_ball_squash(latent)
    return along(center, point, radius), log_det + len(latent) * mp.log(radius)


def ellipsoid_squash(ellipsoid: Ellipsoid, latent: Vector) -> tuple[Vector, mpf]:
    center, tril = to_mp(ellipsoid.center), to_mp(ellipsoid.scale_tril)
    point, log_det = unit_ball_squash(latent)
    action = [m + dot(row, point) for m, row in zip(center, tril, strict=True)]
    return action, log_det + sum(mp.log(tril[i][i]) for i in range(len(latent)))


def gauge_squash(
    sets: Sequence[ConstraintSet], anchor: Tensor, latent: Vector
) -> tuple[Vector, mpf]:
    box, c = sets[0], to_mp(anchor)
    assert isinstance(box, Box)
    bounded, log_det = box_squash(box, latent)
    offset = [x - y for x, y in zip(bounded, c, strict=True)]
    whole = exit_along(c, offset, sets[:1])
    share = exit_along(c, offset, sets) / whole
    return along(c, offset, share), log_det + len(latent) * mp.log(share)


def exact_squash(
    sets: Sequence[ConstraintSet], anchor: Tensor, latent: Vector
) -> tuple[Vector, mpf]:
    """Scale each component to the intersection of the boxes, then retract from there."""
    boxes, others = ([s for s in sets if isinstance(s, Box) == is_box] for is_box in (True, False))
    low, high = boxes[0].low, boxes[0].high
    for box in boxes[1:]:
        low, high = low.maximum(box.low), high.minimum(box.high)
    c = to_mp(anchor)
    bounded, log_det = box_squash(boxes[0], latent)
    offset = []
    for i, x in enumerate(bounded):
        sides = (high, boxes[0].high) if x > c[i] else (low, boxes[0].low)
        ratio = (to_mp(sides[0])[i] - c[i]) / (to_mp(sides[1])[i] - c[i])
        offset.append((x - c[i]) * ratio)
        log_det += mp.log(ratio)
    merged = Box(low, high)
    share = exit_along(c, offset, [merged, *others]) / exit_along(c, offset, [merged])
    return along(c, offset, share), log_det + len(latent) * mp.log(share)


def soft_squash(
    sets: Sequence[ConstraintSet],
    anchor: Tensor,
    latent: Vector,
    *,
    sharpness: int,
    by_components: bool,
) -> tuple[Vector, mpf]:
    """Squash into the bounds, then retract softly: boxes by components, other sets along rays."""
    bounds, c = sets[0], to_mp(anchor)
    assert isinstance(bounds, Box)
    bounded, log_det = box_squash(bounds, latent)
    offset = [x - y for x, y in zip(bounded, c, strict=True)]
    boxes = (
        [constraint_set for constraint_set in sets if isinstance(constraint_set, Box)]
        if by_components
        else [bounds]
    )
    rest = [
        constraint_set
        for constraint_set in sets[1:]
        if not any(constraint_set is box for box in boxes)
    ]
    inner = merged(boxes)
    offset, change = soft_components(bounds, inner, c, offset, sharpness)
    log_det += change
    point, change = soft_ray(exit_along(c, offset, [inner]), [inner, *rest], c, offset, sharpness)
    return point, log_det + change


def soft_retraction(
    sets: Sequence[ConstraintSet], anchor: Tensor, latent: Vector, *, sharpness: int
) -> tuple[Vector, mpf]:
    """Retract R^d softly: bounds and boxes by components, other sets along rays."""
    c = to_mp(anchor)
    offset = [x - y for x, y in zip(latent, c, strict=True)]
    inner = merged([constraint_set for constraint_set in sets if isinstance(constraint_set, Box)])
    rest = [constraint_set for constraint_set in sets if not isinstance(constraint_set, Box)]
    offset, log_det = soft_components(None, inner, c, offset, sharpness)
    point, change = soft_ray(exit_along(c, offset, [inner]), [inner, *rest], c, offset, sharpness)
    return point, log_det + change


def merged(boxes: Sequence[Box]) -> Box:
    low, high = boxes[0].low, boxes[0].high
    for box in boxes[1:]:
        low, high = low.maximum(box.low), high.minimum(box.high)
    return Box(low, high)


def soft_components(
    outer: Box | None, inner: Box, c: Vector, offset: Vector, sharpness: int
) -> tuple[Vector, mpf]:
    moved, log_det = [], mpf(0)
    for i, v in enumerate(offset):
        ends = [(to_mp(b.high if v > 0 else b.low)[i] - c[i]) for b in (inner, outer) if b]
        inverse = [abs(v / end) ** sharpness for end in ends]
        u = 1 + inverse[0] - (inverse[1] if outer else 0)
        moved.append(v * u ** (-mpf(1) / sharpness))
        log_det -= (1 + mpf(1) / sharpness) * mp.log(u)
    return moved, log_det


def soft_ray(
    whole: mpf, sets: Sequence[ConstraintSet], c: Vector, offset: Vector, sharpness: int
) -> tuple[Vector, mpf]:
    """Retract along a ray that leaves the outer set after a multiple of the offset."""
    u = 1 + exit_along(c, offset, sets) ** -sharpness - whole**-sharpness
    share = u ** (-mpf(1) / sharpness)
    return along(c, offset, share), -(mpf(len(offset)) / sharpness + 1) * mp.log(u)


def radial_squash(
    sets: Sequence[ConstraintSet], anchor: Tensor, latent: Vector
) -> tuple[Vector, mpf]:
    c, rho = to_mp(anchor), mp.sqrt(sum(z**2 for z in latent))
    point, log_det = unit_ball_squash(latent)
    width = exit_along(c, [z / rho for z in latent], sets)
    return along(c, point, width), log_det + len(latent) * mp.log(width)


def exit_along(anchor: Vector, offset: Vector, sets: Sequence[ConstraintSet]) -> mpf:
    """Return the largest t with ``anchor + t offset`` in all sets, the first of them a box."""
    box = sets[0]
    assert isinstance(box, Box)
    faces = zip(to_mp(box.low), to_mp(box.high), anchor, offset, strict=True)
    outside = min(((high if v > 0 else low) - c) / v for low, high, c, v in faces if v != 0)
    for constraint_set in sets[1:]:
        inside, beyond = mpf(0), outside
        if level(constraint_set, along(anchor, offset, beyond)) <= 1:
            continue
        while beyond - inside > beyond * mpf(10) ** -20:
            middle = (inside + beyond) / 2
            if level(constraint_set, along(anchor, offset, middle)) <= 1:
                inside = middle
            else:
                beyond = middle
        outside = inside
    return outside


def normal_log_prob(latent: Vector, loc: Vector, scale: Vector) -> mpf:
    total = mpf(0)
    for z, m, sigma in zip(latent, loc, scale, strict=True):
        total -= ((z - m) / sigma) ** 2 / 2 + mp.log(sigma) + mp.log(2 * mp.pi) / 2
    return total


def to_mp(value: Tensor) -> mpf | Vector | list[Vector]:
    """Return the exact values of a tensor, as nested lists."""

    def convert(item: float | list) -> mpf | list:
        return [convert(value) for value in item] if isinstance(item, list) else mpf(item)

    return convert(value.double().tolist())


def along(anchor: Vector, offset: Vector, share: mpf) -> Vector:
    return [c + share * v for c, v in zip(anchor, offset, strict=True)]


def dot(left: Vector, right: Vector) -> mpf:
    return mp.fsum(x * y for x, y in zip(left, right, strict=True))


def distance(left: Vector, right: Vector) -> mpf:
    return mp.sqrt(mp.fsum((x - y) ** 2 for x, y in zip(left, right, strict=True)))


def whitened(tril: list[Vector], action: Vector, center: Vector) -> Vector:
    solution: Vector = []
    for i, row in enumerate(tril):
        solution.append((action[i] - center[i] - dot(row[:i], solution)) / row[i])
    return solution
