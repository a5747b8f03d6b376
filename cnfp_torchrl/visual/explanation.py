"""What happened inside a flow policy in one step, in plain words and numbers."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import torch
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.visual.snapshot import FlowSnapshot
from cnfp_torchrl.visual.words import ConstraintEffect, Effect, Explanation, Vector

_DRAWS = 1024
_MOST_DIMENSIONS_TO_MEASURE = 3
_VISIBLE = 1e-4
"""Ways shorter than this share of the action bounds are rounding, or cannot be seen."""


def explain(
    snapshot: FlowSnapshot,
    *,
    facts: Mapping[str, str] | None = None,
    situation: str | None = None,
) -> Explanation:
    """Explain what a flow policy did in one step.

    Args:
        snapshot: of the step; the followed sample is the executed one.
        facts: what the environment's state says about constraints, sentences by their names
            (`cnfp_torchrl.visual.facts`).
        situation: the environment's state in a sentence.
    """
    facts = facts or {}
    stages = {stage.applied[-1]: i for i, stage in enumerate(snapshot.stages)}
    path = snapshot.path() if snapshot.is_recovered else None
    action = snapshot.stages[-1].samples[snapshot.followed]
    allowed = _allowed(snapshot) if snapshot.dim <= _MOST_DIMENSIONS_TO_MEASURE else None
    effects = tuple(
        _effect(
            snapshot,
            k,
            stages.get(k),
            action,
            path,
            None if allowed is None else _share(allowed[k - 1]),
            facts.get(name),
        )
        for k, name in enumerate(snapshot.constraint_names, start=1)
    )
    kept = [k for k in range(len(effects)) if snapshot.is_active(k + 1)]
    has_bounds = path is not None and 0 in stages
    return Explanation(
        action=_plain(action),
        latent=None if path is None else _plain(snapshot.latents[snapshot.followed]),
        bounded=_plain(path[stages[0]]) if path is not None and has_bounds else None,
        constraints=effects,
        share_allowed=None if allowed is None else _share(allowed[kept].all(0)),
        samples=len(snapshot.latents),
        situation=situation,
        is_safe=snapshot.is_safe,
    )


def _effect(
    snapshot: FlowSnapshot,
    index: int,
    stage: int | None,
    action: Tensor,
    path: Tensor | None,
    share_allowed: float | None,
    fact: str | None,
) -> ConstraintEffect:
    allowed, contained = snapshot.region.sets[index], snapshot.contained[index]
    before = after = moved = share_moved = None
    if stage is not None and path is not None:
        after = path[stage]
        before = path[stage - 1] if stage else snapshot.latents[snapshot.followed].to(after)
    if stage and snapshot.is_safe:
        size = float(vector_norm(snapshot.region.bounds.high - snapshot.region.bounds.low))
        ways = snapshot.stages[stage].samples - snapshot.stages[stage - 1].samples
        share_moved = _share(vector_norm(ways, dim=-1) > _VISIBLE * size)
        if before is not None and after is not None:
            way = float(vector_norm(after - before))
            moved = way if way > _VISIBLE * size else 0.0
    effect: Effect = "restrictive"
    if snapshot.is_safe and not snapshot.is_active(index):
        effect = "dropped"
    elif not bool(contained[snapshot.followed]):
        effect = "broken"
    elif (share_moved == 0 and not moved) if snapshot.is_safe else share_allowed == 1:
        effect = "permissive"
    return ConstraintEffect(
        name=snapshot.constraint_names[index - 1],
        effect=effect,
        before=None if before is None else _plain(before),
        after=None if after is None else _plain(after),
        moved=moved,
        share_moved=share_moved,
        share_outside=_share(~contained),
        share_allowed=share_allowed,
        slack=float(allowed.to(torch.float64).slack(action.double())),
        fact=fact,
    )


def _allowed(snapshot: FlowSnapshot) -> Tensor:
    """Tell which of many actions, spread evenly over the bounds, each set allows, ``(K, n)``."""
    bounds = snapshot.region.bounds
    spread = bounds.low + (bounds.high - bounds.low) * _evenly_spread(snapshot.dim).to(bounds.low)
    allowed = [each.contains(spread) for each in snapshot.region.sets[1:]]
    return torch.stack(allowed) if allowed else torch.ones(0, _DRAWS, dtype=torch.bool)


@cache
def _evenly_spread(dim: int) -> Tensor:
    return torch.quasirandom.SobolEngine(dim, scramble=True, seed=0).draw(_DRAWS)


def _share(mask: Tensor) -> float:
    return float(mask.double().mean())


def _plain(vector: Tensor) -> Vector:
    return tuple(vector.tolist())
