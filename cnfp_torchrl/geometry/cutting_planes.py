"""The largest smallest slack when some sets state no more than a concave slack."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from cnfp_torchrl.geometry.barrier import Best, is_settled, maximize_slack
from cnfp_torchrl.geometry.constraint_set import ConstraintSet
from cnfp_torchrl.geometry.slack_program import Program

MAX_CUTS = 1000
"""Linearizations of each set before the method gives up with an error."""


def maximize_slack_by_cuts(
    problem: Program,
    sets: Sequence[ConstraintSet],
    active: Tensor,
    start: Tensor,
    scale: Tensor,
    enough: float,
    share: float,
) -> Best:
    r"""Do what `maximize_slack` does with further sets, of which only the slack is known.

    A concave slack lies below its linearizations, :math:`slack(x) \le slack(a) + g \cdot (x - a)`:
    rows that are added at each point found (Kelley 1960, at points well inside the rows so far).
    Upper bounds hold for the rows, so for the sets.

    Args:
        problem: B problems in float64, without the sets.
        sets: the further sets, each of batch shape ``(B,)``, in float64.
        active: which of them count, boolean ``(B, len(sets))``.
        start: the middles of the action bounds, ``(B, d)``.
        scale: their mean widths, ``(B,)``.
        enough: the smallest slack of interest.
        share: the share of the best slack that will do, below 1.

    Raises:
        RuntimeError: when a problem is undecided after `MAX_CUTS`.
    """
    found = Best(
        start.clone(), torch.full_like(scale, -torch.inf), torch.full_like(scale, torch.inf)
    )
    left = torch.arange(len(start), device=start.device)
    weights = active.to(start)
    for _ in range(MAX_CUTS):
        trial = maximize_slack(problem, start[left], scale[left], enough, (1 + share) / 2)
        slacks, gradients = _linearized(sets, left, len(start), trial.action)
        slack = torch.where(weights > 0, slacks, torch.inf).amin(-1).minimum(trial.slack)
        better = slack > found.slack[left]
        found.action[left] = torch.where(better.unsqueeze(-1), trial.action, found.action[left])
        found.slack[left] = torch.where(better, slack, found.slack[left])
        found.upper_bound[left] = found.upper_bound[left].minimum(trial.upper_bound)
        lower, upper = found.slack[left], found.upper_bound[left]
        undecided = ~is_settled(lower, upper, scale[left], enough, share)
        if not bool(undecided.any()):
            return found
        offsets = slacks - (gradients * trial.action.unsqueeze(-2)).sum(-1)
        problem = problem.with_rows(-gradients, offsets, weights).select(undecided)
        left, weights = left[undecided], weights[undecided]
    raise RuntimeError(
        f"{len(left)} of {len(start)} intersections undecided after {MAX_CUTS} linearizations; "
        f"the first has slack {found.slack[left][0]:.3g}, at most {found.upper_bound[left][0]:.3g}"
    )


def _linearized(
    sets: Sequence[ConstraintSet], index: Tensor, batch: int, action: Tensor
) -> tuple[Tensor, Tensor]:
    """Return slacks ``(B, len(sets))`` and their gradients ``(B, len(sets), d)``."""
    slacks, gradients = [], []
    for each in sets:
        with torch.enable_grad():
            at = action.detach().requires_grad_()
            slack = each.select(torch.Size([batch]), index).slack(at)
            gradients.append(torch.autograd.grad(slack.sum(), at)[0])
        slacks.append(slack.detach())
    return torch.stack(slacks, -1), torch.stack(gradients, -2)
