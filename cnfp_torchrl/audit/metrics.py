"""Measurements of the actions that an audit samples, and of those that a policy executed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict.utils import NestedKey
from torch import Tensor

from cnfp_torchrl.audit.lookahead import StepReader
from cnfp_torchrl.audit.report import TOGETHER, ConstraintMetrics, Executed, WorstState
from cnfp_torchrl.audit.rollouts import Rollouts
from cnfp_torchrl.audit.samples import Samples, describe_state
from cnfp_torchrl.audit.statistics import Share, plain, quantiles
from cnfp_torchrl.geometry import relaxation_floor
from cnfp_torchrl.keys import CONSTRAINT_STATES
from cnfp_torchrl.modules import ConstrainedFlowModule


@dataclass(frozen=True)
class _Subject:
    """The set of one constraint, or the intersection of all of them, as it is measured.

    Args:
        name: The constraint's name, or `TOGETHER`.
        judged: Whether there is an indicator.
        holds: The mask of the states in which it is active, ``(n,)``.
        had: The mask of those in which it gives way by no more than a set without interior,
            ``(n,)``.
        amount: The amount by which it is relaxed, infinite where dropped, ``(n,)``; together the
            largest one.
        left: The mask of the actions outside the set as it counts: widened where it is relaxed, and
            none where it is dropped, ``(2 m, n)``.
        inside: The mask of the actions in the set, ``(2 m, n)``.
        reached: The mask of the actions that count as covered, ``(2 m, n)``.
        violated: The mask of the actions that the indicator calls violations, ``(2 m, n)``.
        kept: The mask of the actions after which it is active, ``(2 m, n)``.
        slack: The slack of the actions, ``(2 m, n)``.
        anchor_slack: The slack of the anchor, ``(n,)``.
    """

    name: str
    judged: bool
    holds: Tensor
    had: Tensor
    amount: Tensor
    left: Tensor
    inside: Tensor
    reached: Tensor
    violated: Tensor
    kept: Tensor
    slack: Tensor
    anchor_slack: Tensor


def measure(samples: Samples, examples: int) -> list[ConstraintMetrics]:
    """Return the metrics of each constraint, and of all of them together."""
    subjects = [*(_single(samples, k) for k in range(len(samples.judged))), _together(samples)]
    return [_measure(samples, subject, examples) for subject in subjects]


def _single(samples: Samples, k: int) -> _Subject:
    allowed, relaxed = samples.region.sets[k + 1], samples.region.widened()[k + 1]
    inside, amount = allowed.contains(samples.actions), samples.amounts[:, k]
    left, floor = ~relaxed.contains(samples.actions), relaxation_floor(samples.region.sets)
    return _Subject(
        name=samples.head.order[k],
        judged=samples.judged[k],
        holds=samples.active[:, k],
        had=amount <= floor[..., k + 1].nan_to_num(0.0, 0.0),
        amount=amount,
        left=left & ~amount.isinf(),
        inside=inside,
        reached=inside,
        violated=samples.violated[..., k],
        kept=samples.kept[..., k],
        slack=allowed.slack(samples.actions),
        anchor_slack=allowed.slack(samples.region.anchor).expand(len(samples.states)),
    )


def _together(samples: Samples) -> _Subject:
    region = samples.region
    inside = region.contains(samples.actions)
    return _Subject(
        name=TOGETHER,
        judged=any(samples.judged),
        holds=samples.active.all(-1),
        had=samples.active.all(-1),
        amount=samples.amounts.amax(-1),
        left=~inside,
        inside=inside,
        reached=samples.reachable,
        violated=samples.violated.any(-1),
        kept=samples.kept.all(-1),
        slack=region.slack(samples.actions),
        anchor_slack=region.slack(region.anchor),
    )


def _measure(samples: Samples, subject: _Subject, examples: int) -> ConstraintMetrics:
    m, holds = samples.half, subject.holds
    checked = subject.inside & holds
    unsound = checked & subject.violated
    escaped, binding = subject.left[:m], ~subject.amount.isinf()
    if subject.name == TOGETHER:
        binding = torch.ones_like(holds)
    relaxed, dropped = ~holds & subject.amount.isfinite(), subject.amount.isinf()
    onwards, dead_ends = _next_states(samples, subject.kept)
    allowed = ~subject.violated[m:]
    possible = allowed.any(0) & ~holds
    covered, coverable = allowed & subject.reached[m:] & holds, allowed & holds
    binds = ~subject.inside[m:].all(0)

    def worst(mask: Tensor, depth: Tensor = subject.slack) -> list[dict[str, Any]]:
        return [samples.describe(*pair) for pair in _deepest(mask, depth, examples)]

    gave_way = (~holds).nonzero().squeeze(-1)
    # Where the indicators did not call for it comes first.
    gave_way = gave_way[possible[gave_way].int().argsort(descending=True, stable=True)]
    return ConstraintMetrics(
        name=subject.name,
        unsound=_share(unsound, checked) if subject.judged else None,
        escaped=_share(escaped, binding.expand_as(escaped)),
        dead_ends=_share(dead_ends, onwards),
        coverage=_share(covered, coverable) if subject.judged else None,
        binding=_share(covered & binds, coverable & binds) if subject.judged else None,
        relaxed=_share_of_states(relaxed),
        dropped=_share_of_states(dropped),
        gave_way=_share_of_states(~holds),
        had=_share_of_states(subject.had),
        relaxation=quantiles(subject.amount[relaxed]),
        possible=_share(possible.unsqueeze(0), ~holds.unsqueeze(0)) if subject.judged else None,
        volume=quantiles(subject.inside[m:].double().mean(0)[holds]),
        slack=quantiles(subject.anchor_slack[holds]),
        examples={
            "unsound": worst(unsound) if subject.judged else [],
            "escaped": worst(_padded(escaped, m), -subject.slack),
            "dead_ends": worst(_padded(dead_ends, m)),
            "gave_way": [samples.describe_state(int(i)) for i in gave_way[:examples]],
        },
    )


def _next_states(samples: Samples, kept: Tensor) -> tuple[Tensor, Tensor]:
    """Return the flow's samples that break nothing, and those after which something gives way.

    Only in states where every constraint is active is anything promised about the next state.
    """
    m = samples.half
    onwards = samples.region.contains(samples.actions[:m]) & ~samples.violated[:m].any(-1)
    onwards = onwards & samples.active.all(-1)
    return onwards, onwards & ~kept[:m]


def _share(hits: Tensor, of: Tensor) -> Share:
    return Share.clustered(hits.sum(0), of.sum(0))


def _share_of_states(mask: Tensor) -> Share:
    return _share(mask.unsqueeze(0), torch.ones_like(mask).unsqueeze(0))


def _padded(mask: Tensor, rows: int) -> Tensor:
    return torch.cat([mask, torch.zeros_like(mask[:1]).expand(rows, -1)])


def _deepest(mask: Tensor, slack: Tensor, count: int) -> list[tuple[int, int]]:
    """Return (row, state) of the marked actions with the most slack, one for each state."""
    # Some slacks are infinite; only actions that are not marked may count as minus infinity.
    depth, row = torch.where(mask, slack.clamp(min=-1e30), -torch.inf).max(0)
    states = mask.any(0).nonzero().squeeze(-1)
    states = states[depth[states].argsort(descending=True)][:count]
    return [(int(row[s]), int(s)) for s in states]


def worst_state(samples: Samples, name: str, source: str) -> tuple[float, WorstState]:
    """Return the state that speaks most against a constraint's set, and how much it does.

    Most violations inside the set, else most dead ends, else the least coverage.
    """
    k, m, region = samples.head.order.index(name), samples.half, samples.region
    inside, bad = region.sets[k + 1].contains(samples.actions), samples.violated[..., k]
    dead_end = _padded(_next_states(samples, samples.kept[..., k])[1], m)
    unsound, ends = (inside & bad).sum(0), dead_end.sum(0)
    allowed = ~bad[m:]
    covered = (allowed & inside[m:]).sum(0) / allowed.sum(0).clamp(min=1)
    # Counts rank before shares, and violations before dead ends.
    against = torch.where(
        unsound > 0, 2e6 + unsound, torch.where(ends > 0, 1e6 + ends, 1 - covered)
    )
    against = torch.where(samples.active[:, k], against, -1.0)
    s = int(against.argmax())
    if unsound[s] > 0:
        reason = f"{int(unsound[s])} actions in the set violate"
    elif ends[s] > 0:
        reason = f"{int(ends[s])} allowed actions lead to where it gives way"
    else:
        reason = f"{100 * float(covered[s]):.0f} % of the allowed actions are in the set"
    here = samples.head.get_region(samples.states[s])
    tried = [x[:, s].cpu() for x in (samples.actions, inside, bad, dead_end)]
    entries = samples.describe_state(s)["state"]
    return float(against[s]), WorstState(
        name, source, reason, entries, here.to(device="cpu"), *tried
    )


def executed(
    rollouts: Rollouts,
    reader: StepReader,
    head: ConstrainedFlowModule,
    keys: Sequence[NestedKey],
    examples: int,
) -> Executed:
    """Count the violations of rollouts, and those that allowed actions led into.

    Args:
        rollouts: The rollouts.
        reader: What reads indicators and flags.
        head: The flow module.
        keys: The entries of a state that identify it.
        examples: The number of examples to keep of each constraint.
    """
    steps, agents = rollouts.ended.shape
    time = torch.arange(steps, device=rollouts.ended.device).unsqueeze(-1).expand(steps, agents)
    begins = torch.cat([torch.ones_like(rollouts.ended[:1]), rollouts.ended[:-1]])
    start = torch.where(begins, time, 0).cummax(0).values
    active, amounts = reader.active(rollouts.states), reader.amounts(rollouts.states)
    led_into, shown, held, broken = {}, {}, {}, {}
    for k, name in enumerate(head.order):
        dropped = amounts[..., k].isinf()
        masks = (active[..., k], ~active[..., k] & ~dropped, dropped)
        held[name] = {
            state: int(mask.sum()) for state, mask in zip(CONSTRAINT_STATES, masks, strict=True)
        }
        if name not in reader.names:
            continue
        bad = rollouts.violated[..., reader.names.index(name)]
        last = torch.where(active[..., k], time, -1).cummax(0).values
        led = bad & (last >= start)
        led_into[name] = int(led.sum())
        broken[name] = {
            state: int((bad & mask).sum())
            for state, mask in zip(CONSTRAINT_STATES, masks, strict=True)
        }
        # One example an agent: what comes after the first is the same story.
        first = led & (led.cumsum(0) == 1)
        shown[name] = [
            describe_state(head, rollouts.states[last[t, b], b], keys)
            | {"action": plain(rollouts.states[last[t, b], b].get(head.action_key))}
            | {"steps_until_violation": int(t - last[t, b])}
            for t, b in first.nonzero()[:examples].tolist()
        ]
    counts = rollouts.violated.flatten(0, 1).sum(0).tolist()
    violations = dict(zip(reader.names, counts, strict=True))
    return Executed(steps * agents, violations, led_into, shown, held, broken)
