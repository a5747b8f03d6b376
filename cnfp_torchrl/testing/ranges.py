"""Checks of field values over the whole range of a dtype: right, or refused by `invalid_fields`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial

import torch
from torch import Tensor

from cnfp_torchrl.bijectors import GaugeSquash
from cnfp_torchrl.geometry import ConstraintSet, Region, largest_value
from cnfp_torchrl.testing.example import DTYPES, Example
from cnfp_torchrl.testing.family_error import called, require

_DECADES = {torch.float32: 30.0, torch.float64: 140.0}
"""Powers of ten by which fields are made larger or smaller."""


def check_field_range(example: Example) -> None:
    """Fields scaled over the dtype's whole range give numbers, and flows that stay inside.

    Fields are scaled one alone, all by one factor, and all by factors of their own. Sets that are
    invalid then, or no longer hold the anchor with room to spare, do not count.
    """
    for dtype in DTYPES:
        bounds, sets = example.cast(dtype)
        rays = example.rays[0].cast(dtype)
        for scaled in _scaled(example, sets):
            valid = _valid(scaled)
            slack = scaled.slack(rays.anchor)
            gauge = scaled.gauge(rays.directions, rays.anchor)
            at = {"anchor": rays.anchor}
            require(scaled, "slack", ~valid | ~slack.isnan(), "a number", "it", slack, **at)
            inside = (slack > 0) & ~scaled.contains(rays.anchor) & valid
            clear = slack.abs() > 1e-3 * example.size.to(dtype)
            expected = "an anchor inside where its slack is positive"
            require(scaled, "contains", ~(inside & clear), expected, "a slack of", slack, **at)
            eroded = called(type(scaled), "eroded", partial(scaled.eroded, bounds.magnitude()))
            roomy = valid & (eroded.slack(rays.anchor) > 1e-2 * example.size.to(dtype))
            expected = "a gauge of 0 or more, and no NaN"
            holds = ~roomy | (gauge >= 0)
            require(scaled, "gauge", holds, expected, "it", gauge, direction=rays.directions, **at)
            # Dropped elsewhere, not left out: the family's substitute for it is checked as well.
            active = torch.stack([torch.ones_like(roomy), roomy], -1)
            flow = GaugeSquash(Region((bounds, scaled), rays.anchor, active))
            latent = example.normal(len(rays.directions), *rays.anchor.shape).to(dtype)
            latent = latent * 10 ** (4 * example.uniform(len(latent), 1, 1).to(dtype) - 2)
            action, log_det = flow.forward_and_log_det(latent)
            finite = action.isfinite().all(-1) & log_det.isfinite() | ~valid
            at |= {"latent": latent}
            expected = "finite actions and log-determinants of a flow"
            require(scaled, "gauge", finite, expected, "a log-determinant of", log_det, **at)
            kept = scaled.contains(action) | ~roomy
            expected = "actions of a flow inside the set"
            require(scaled, "eroded", kept, expected, "a slack of", scaled.slack(action), **at)


def _scaled(example: Example, sets: ConstraintSet) -> Iterator[ConstraintSet]:
    names = list(sets.fields())
    for name in names:
        yield _times(sets, {name: _factors(example, sets)})
    for _ in range(3):
        common = _factors(example, sets)
        yield _times(sets, dict.fromkeys(names, common))
        yield _times(sets, {name: _factors(example, sets) for name in names})


def _factors(example: Example, sets: ConstraintSet) -> Tensor:
    """Return powers of ten, ``(B,)``, spread evenly over the decades of the dtype."""
    exponent = (2 * example.uniform(*sets.batch_shape) - 1) * _DECADES[sets.dtype]
    return (10.0**exponent).to(sets.dtype)


def _times(sets: ConstraintSet, factors: Mapping[str, Tensor]) -> ConstraintSet:
    scaled = {
        name: value * factors[name].view(-1, *(1,) * (value.ndim - 1)) if name in factors else value
        for name, value in sets.fields().items()
    }
    return type(sets)(**scaled, validate_args=False)


def _valid(sets: ConstraintSet) -> Tensor:
    """Return which sets of a batch ``(B,)`` would not be refused."""
    like = next(iter(sets.fields().values()))
    valid = torch.ones(sets.batch_shape, dtype=torch.bool, device=like.device)
    tiny, most = torch.finfo(sets.dtype).tiny, largest_value(sets.dtype)
    bad = [mask for _, mask, _ in sets.invalid_fields()]
    for field, value in sets.fields().items():
        size = value.abs()
        if field in sets.finite_fields:
            bad.append(size.isinf())
        # Scaling to infinity or to a subnormal number has changed the set, not its size.
        bad += [size.isfinite() & (size > most), (size > 0) & (size < tiny), value.isnan()]
    for mask in bad:
        valid = valid & ~mask.reshape(len(valid), -1).any(-1)
    return valid
