"""What is counted about the actions that an audit tried, and about those that were executed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict.utils import NestedKey
from torch import Tensor

from cnfp_torchrl.audit.probes import Reader
from cnfp_torchrl.audit.report import (
    TOGETHER,
    Executed,
    Findings,
    Scene,
    Share,
    plain,
    quantiles,
)
from cnfp_torchrl.audit.rollouts import Record
from cnfp_torchrl.audit.trial import Trial, describe
from cnfp_torchrl.modules import ConstrainedFlowModule


@dataclass(frozen=True)
class _Subject:
    """What is measured: the set of one constraint, or the intersection of all of them.

    Args:
        name: of the constraint, or `TOGETHER`.
        judged: whether an indicator judges.
        holds: the states in which it is active, ``(n,)``.
        inside: the actions in the set, ``(2 m, n)``.
        reached: the actions that count as covered, ``(2 m, n)``.
        violated: the actions that the indicator calls violations, ``(2 m, n)``.
        kept: the actions after which it is active, ``(2 m, n)``.
        slack: of the actions, ``(2 m, n)``.
        room: slack of the anchor, ``(n,)``.
    """

    name: str
    judged: bool
    holds: Tensor
    inside: Tensor
    reached: Tensor
    violated: Tensor
    kept: Tensor
    slack: Tensor
    room: Tensor


def findings(trial: Trial, examples: int) -> list[Findings]:
    """Return what the trial says about each constraint, and about all of them together."""
    subjects = [*(_single(trial, k) for k in range(len(trial.judged))), _together(trial)]
    return [_measure(trial, subject, examples) for subject in subjects]


def _single(trial: Trial, k: int) -> _Subject:
    each = trial.region.sets[k + 1]
    inside = each.contains(trial.actions)
    return _Subject(
        name=trial.head.order[k],
        judged=trial.judged[k],
        holds=trial.active[:, k],
        inside=inside,
        reached=inside,
        violated=trial.violated[..., k],
        kept=trial.kept[..., k],
        slack=each.slack(trial.actions),
        room=each.slack(trial.region.anchor).expand(len(trial.states)),
    )


def _together(trial: Trial) -> _Subject:
    region = trial.region
    return _Subject(
        name=TOGETHER,
        judged=any(trial.judged),
        holds=trial.active.all(-1),
        inside=region.contains(trial.actions),
        reached=trial.reachable,
        violated=trial.violated.any(-1),
        kept=trial.kept.all(-1),
        slack=region.slack(trial.actions),
        room=region.slack(region.anchor),
    )


def _measure(trial: Trial, subject: _Subject, examples: int) -> Findings:
    m, holds = trial.half, subject.holds
    checked = subject.inside & holds
    unsound = checked & subject.violated
    escaped = ~subject.inside[:m] & holds
    onwards, dead_ends = _next_states(trial, subject.kept)
    allowed = ~subject.violated[m:]
    possible = allowed.any(0) & ~holds
    covered, coverable = allowed & subject.reached[m:] & holds, allowed & holds
    binds = ~subject.inside[m:].all(0)

    def worst(mask: Tensor, depth: Tensor = subject.slack) -> list[dict[str, Any]]:
        return [trial.tried(*pair) for pair in _deepest(mask, depth, examples)]

    dropped = (~holds).nonzero().squeeze(-1)
    # A drop that the indicators did not call for comes first.
    dropped = dropped[possible[dropped].int().argsort(descending=True, stable=True)]
    return Findings(
        name=subject.name,
        unsound=_share(unsound, checked) if subject.judged else None,
        escaped=_share(escaped, holds.expand_as(escaped)),
        dead_ends=_share(dead_ends, onwards),
        coverage=_share(covered, coverable) if subject.judged else None,
        binding=_share(covered & binds, coverable & binds) if subject.judged else None,
        dropped=_share(~holds.unsqueeze(0), torch.ones_like(holds).unsqueeze(0)),
        possible=_share(possible.unsqueeze(0), ~holds.unsqueeze(0)) if subject.judged else None,
        volume=quantiles(subject.inside[m:].double().mean(0)[holds]),
        slack=quantiles(subject.room[holds]),
        examples={
            "unsound": worst(unsound) if subject.judged else [],
            "escaped": worst(_padded(escaped, m), -subject.slack),
            "dead_ends": worst(_padded(dead_ends, m)),
            "dropped": [trial.described(int(i)) for i in dropped[:examples]],
        },
    )


def _next_states(trial: Trial, kept: Tensor) -> tuple[Tensor, Tensor]:
    """Return the flow's samples that break nothing, and those after which something is dropped.

    Only in states where every constraint is active is anything promised about the next state.
    """
    m = trial.half
    onwards = trial.region.contains(trial.actions[:m]) & ~trial.violated[:m].any(-1)
    onwards = onwards & trial.active.all(-1)
    return onwards, onwards & ~kept[:m]


def _share(hits: Tensor, of: Tensor) -> Share:
    return Share.clustered(hits.sum(0), of.sum(0))


def _padded(mask: Tensor, rows: int) -> Tensor:
    return torch.cat([mask, torch.zeros_like(mask[:1]).expand(rows, -1)])


def _deepest(mask: Tensor, slack: Tensor, count: int) -> list[tuple[int, int]]:
    """Return (row, state) of the marked actions with the most slack, one for each state."""
    # Some slacks are infinite; only actions that are not marked may count as minus infinity.
    depth, row = torch.where(mask, slack.clamp(min=-1e30), -torch.inf).max(0)
    states = mask.any(0).nonzero().squeeze(-1)
    states = states[depth[states].argsort(descending=True)][:count]
    return [(int(row[s]), int(s)) for s in states]


def worst_scene(trial: Trial, name: str, source: str) -> tuple[float, Scene]:
    """Return the state that speaks most against a constraint's set, and how much it does.

    Most violations inside the set, else most dead ends, else the least coverage.
    """
    k, m, region = trial.head.order.index(name), trial.half, trial.region
    inside, bad = region.sets[k + 1].contains(trial.actions), trial.violated[..., k]
    dead_end = _padded(_next_states(trial, trial.kept[..., k])[1], m)
    unsound, ends = (inside & bad).sum(0), dead_end.sum(0)
    allowed = ~bad[m:]
    covered = (allowed & inside[m:]).sum(0) / allowed.sum(0).clamp(min=1)
    # Counts rank before shares, and violations before dead ends.
    against = torch.where(
        unsound > 0, 2e6 + unsound, torch.where(ends > 0, 1e6 + ends, 1 - covered)
    )
    against = torch.where(trial.active[:, k], against, -1.0)
    s = int(against.argmax())
    if unsound[s] > 0:
        why = f"{int(unsound[s])} actions in the set violate"
    elif ends[s] > 0:
        why = f"{int(ends[s])} allowed actions lead to where it is dropped"
    else:
        why = f"{100 * float(covered[s]):.0f} % of the allowed actions are in the set"
    here = trial.head.get_region(trial.states[s])
    tried = [x[:, s].cpu() for x in (trial.actions, inside, bad, dead_end)]
    entries = trial.described(s)["state"]
    return float(against[s]), Scene(name, source, why, entries, here.to(device="cpu"), *tried)


def executed(
    record: Record,
    reader: Reader,
    head: ConstrainedFlowModule,
    keys: Sequence[NestedKey],
    examples: int,
) -> Executed:
    """Count the violations of rollouts, and those that allowed actions led into.

    Args:
        record: the rollouts.
        reader: of steps.
        head: the flow.
        keys: the entries of a state that say which one it is.
        examples: how many to keep for each constraint.
    """
    steps, agents = record.ended.shape
    time = torch.arange(steps, device=record.ended.device).unsqueeze(-1).expand(steps, agents)
    begins = torch.cat([torch.ones_like(record.ended[:1]), record.ended[:-1]])
    start = torch.where(begins, time, 0).cummax(0).values
    active = reader.active(record.states)
    led_into, shown = {}, {}
    for k, name in enumerate(head.order):
        if name not in reader.names:
            continue
        bad = record.violated[..., reader.names.index(name)]
        last = torch.where(active[..., k], time, -1).cummax(0).values
        led = bad & (last >= start)
        led_into[name] = int(led.sum())
        # One example an agent: what comes after the first is the same story.
        first = led & (led.cumsum(0) == 1)
        shown[name] = [
            describe(head, record.states[last[t, b], b], keys)
            | {"action": plain(record.states[last[t, b], b].get(head.action_key))}
            | {"steps_until_violation": int(t - last[t, b])}
            for t, b in first.nonzero()[:examples].tolist()
        ]
    counts = record.violated.flatten(0, 1).sum(0).tolist()
    violations = dict(zip(reader.names, counts, strict=True))
    return Executed(steps * agents, violations, led_into, shown)
