"""Where the paper's chain and the exact flow put samples of random sets.

Counted when the report is written, with a fixed seed; no training is involved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from cnfp_torchrl.bijectors import Bijector, ExactSquash, SquashChain, paper_squash
from cnfp_torchrl.geometry import Ball, Box, ConstraintSet, Region

CASES, SAMPLES = 400, 2000


@dataclass(frozen=True)
class Tried:
    """What became of samples of a standard normal in random cases.

    Args:
        cases: How many of the cases were of the kind looked for.
        outside: The share of the samples of all these cases outside a set that was judged, by flow.
        broken: The number of cases with such a sample, by flow.
    """

    cases: int
    outside: dict[str, float]
    broken: dict[str, int]


@cache
def intersecting(*families: type[Ball] | type[Box]) -> Tried:
    """Judge all sets where all have points in common.

    Args:
        families: The families of the constraints, in order of application.
    """
    region = _random_region(families)
    assert region.active is not None
    return _try(region, region.active.all(-1), judged=range(1, len(region.sets)))


@cache
def incompatible() -> Tried:
    """Judge the last set, of the highest priority, where a ball and a box have no common point."""
    region = _random_region([Ball, Box])
    assert region.active is not None
    return _try(region, ~region.active[:, 1] & region.active[:, 2], judged=[2])


def _random_region(families: Sequence[type[Ball] | type[Box]]) -> Region:
    generator = torch.Generator().manual_seed(0)

    def uniform(low: float, high: float, *size: int) -> Tensor:
        return low + (high - low) * torch.rand(CASES, *size, generator=generator)

    sets: list[ConstraintSet] = [Box(-torch.ones(CASES, 2), torch.ones(CASES, 2))]
    for family in families:
        middle = uniform(-0.7, 0.7, 2)
        if family is Ball:
            sets.append(Ball(middle, uniform(0.2, 0.7)))
        else:
            reach = uniform(0.2, 0.7, 2)
            sets.append(Box(middle - reach, middle + reach))
    return Region.build(sets)


def _try(region: Region, chosen: Tensor, judged: Sequence[int]) -> Tried:
    bijectors: dict[str, Bijector] = {
        "squash": SquashChain([paper_squash(constraint_set) for constraint_set in region.sets[1:]]),
        "exact": ExactSquash(region),
    }
    outside, broken = {}, {}
    for flow, bijector in bijectors.items():
        generator = torch.Generator().manual_seed(1)
        noise = torch.randn(SAMPLES, CASES, 2, generator=generator)
        actions, _ = bijector.forward_and_log_det(noise)
        left = torch.stack([~region.sets[k].contains(actions) for k in judged]).any(0)[:, chosen]
        outside[flow] = float(left.double().mean())
        broken[flow] = int(left.any(0).sum())
    return Tried(int(chosen.sum()), outside, broken)
