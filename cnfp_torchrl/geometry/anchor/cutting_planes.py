"""The largest smallest slack in sets some of which state a concave slack alone."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from cnfp_torchrl.geometry.anchor.interior_point import Best, Settled, maximize_slack
from cnfp_torchrl.geometry.anchor.program import Program
from cnfp_torchrl.geometry.constraint_set import ConstraintSet

MAX_CUTS = 300
"""The number of linearizations of each set after which the best point so far is taken."""


def maximize_slack_by_cuts(
    problem: Program,
    sets: Sequence[ConstraintSet],
    required: Tensor,
    trial: Tensor,
    counts: Tensor,
    start: Tensor,
    settled: Settled,
) -> Best:
    r"""Do what `maximize_slack` does with further sets, of which only the slack is known.

    A concave slack lies below its linearizations, :math:`slack(x) \le slack(a) + g \cdot (x - a)`:
    rows that are added at each point found (Kelley 1960, at points well inside the rows so far).
    Upper bounds hold for the rows, so for the sets. A point outside of a set that must hold is
    drawn back towards the start until it is inside.

    Args:
        problem: B problems in float64, without the sets.
        sets: further sets, each of batch shape ``(B,)``, in float64.
        required: slacks that those on trial exceed by t, ``(B, len(sets))``.
        trial: flags of the sets on trial, boolean ``(B, len(sets))``.
        counts: flags of the sets that count, boolean ``(B, len(sets))``.
        start: points strictly inside of all that must hold, ``(B, d)``.
        settled: function that tells which problems need no more work.
    """
    least = torch.full_like(start[:, 0], -torch.inf)
    found = Best(start.clone(), least, -least)
    left = torch.arange(len(start), device=start.device)
    for _ in range(MAX_CUTS):
        at, needs, tried, on = start[left], required[left], trial[left], counts[left]

        def half_settled(lower: Tensor, upper: Tensor, index: Tensor) -> Tensor:
            """Tell where a point is well inside the rows so far."""
            total = left[index]  # noqa: B023 - called before left changes
            lowest = found.slack[total]
            return (lower - lowest >= (upper - lowest) / 2) | settled(lower, upper, total)

        best = maximize_slack(problem, at, half_settled)
        slacks, gradients = _linearized(sets, left, len(start), best.action)
        rooms, rooms_at_start = (
            torch.where(on, slack - needs, torch.inf)
            for slack in (slacks, _slacks(sets, left, len(start), at))
        )
        # Of what must hold, at least the chord to the start does.
        share = rooms_at_start / (rooms_at_start - rooms)
        share = torch.where((rooms < 0) & ~tried & on, share, 1.0).amin(-1, keepdim=True)
        action = at + share * (best.action - at)
        rooms = _slacks(sets, left, len(start), action) - needs
        slack = torch.where(on & tried, rooms, torch.inf).amin(-1).minimum(problem.slack(action))
        better = slack > found.slack[left]
        found.action[left] = torch.where(better.unsqueeze(-1), action, found.action[left])
        found.slack[left] = torch.where(better, slack, found.slack[left])
        found.upper_bound[left] = found.upper_bound[left].minimum(best.upper_bound)
        undecided = ~settled(found.slack[left], found.upper_bound[left], left)
        if not bool(undecided.any()):
            break
        offsets = slacks - needs - (gradients * best.action.unsqueeze(-2)).sum(-1)
        problem = problem.with_rows(-gradients, offsets, tried, on)
        problem, left = problem.select(undecided), left[undecided]
    return found


def _slacks(sets: Sequence[ConstraintSet], index: Tensor, batch: int, action: Tensor) -> Tensor:
    """Return slacks ``(B, len(sets))``."""
    chosen = [s.select(torch.Size([batch]), index) for s in sets]
    return torch.stack([s.slack(action) for s in chosen], -1)


def _linearized(
    sets: Sequence[ConstraintSet], index: Tensor, batch: int, action: Tensor
) -> tuple[Tensor, Tensor]:
    """Return slacks ``(B, len(sets))`` and their gradients ``(B, len(sets), d)``."""
    slacks, gradients = [], []
    for constraint_set in sets:
        with torch.enable_grad():
            at = action.detach().requires_grad_()
            slack = constraint_set.select(torch.Size([batch]), index).slack(at)
            gradients.append(torch.autograd.grad(slack.sum(), at)[0])
        slacks.append(slack.detach())
    return torch.stack(slacks, -1), torch.stack(gradients, -2)
