"""An episode in a table: what the constraints did in each step, and the steps worth a look."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.keys import COST_KEY, REWARD_KEY
from cnfp_torchrl.modules import flow_head
from cnfp_torchrl.text_table import text_table
from cnfp_torchrl.visual.explanation import explain
from cnfp_torchrl.visual.replay import replay_step

_SAMPLES = 128
_MOST_OF_A_KIND = 3
_ALIKE = 10
"""Steps at most so far from one that was chosen are not chosen for the same reason."""


@dataclass(frozen=True)
class StepRecord:
    """What the constraints did in one step.

    Args:
        number: The number of the step in its episode, from 0.
        reward: The reward of the step.
        moved: The distances by which constraints moved the action; none where the flow does not
            tell.
        allowed_before: The share of the policy's samples that would be allowed without the flow.
        relaxation: The amount by which constraints are relaxed, of those that are; infinite where
            dropped.
        violations: The constraints that the environment counts a violation of.
    """

    number: int
    reward: float
    moved: Mapping[str, float]
    allowed_before: float
    relaxation: Mapping[str, float]
    violations: tuple[str, ...]


def step_records(
    actor: SafeProbabilisticTensorDictSequential,
    episode: Sequence[TensorDictBase],
    judged: Sequence[str] = (),
) -> list[StepRecord]:
    """Return a record of each step of an episode.

    Args:
        actor: A constrained actor, from `make_constrained_actor` or `constrain`.
        episode: The transitions, of batch size ``()``.
        judged: The names of the columns of ``cost``.
    """
    dim = flow_head(actor).action_dim
    noise = torch.randn(_SAMPLES, dim, generator=torch.Generator().manual_seed(0))
    return [_record(actor, number, step, judged, noise) for number, step in enumerate(episode)]


def _record(
    actor: SafeProbabilisticTensorDictSequential,
    number: int,
    transition: TensorDictBase,
    judged: Sequence[str],
    noise: torch.Tensor,
) -> StepRecord:
    snapshot = replay_step(actor, transition, noise)
    effects = explain(snapshot).constraints
    costs = transition["next", COST_KEY].tolist() if judged else []
    return StepRecord(
        number,
        float(transition["next", REWARD_KEY].sum()),
        {effect.name: effect.moved for effect in effects if effect.moved is not None},
        snapshot.share_allowed_before,
        {effect.name: effect.relaxation for effect in effects if effect.relaxation > 0},
        tuple(name for name, cost in zip(judged, costs, strict=False) if cost),
    )


def steps_worth_a_look(records: Sequence[StepRecord]) -> list[tuple[StepRecord, str]]:
    """Return the steps that tell most about the constraints, in order, with the reason.

    Violations and the steps before them, the largest relaxations, the actions that each constraint
    moved farthest, and the steps in which the fewest samples would be allowed without the flow; of
    each kind a few that lie apart.
    """
    reasons: dict[int, list[str]] = {}
    for number, reason in _findings(records):
        reasons.setdefault(number, []).append(reason)
    return [(records[number], "; ".join(reasons[number])) for number in sorted(reasons)]


def _findings(records: Sequence[StepRecord]) -> Iterator[tuple[int, str]]:
    broken = {r.number: float(bool(r.violations)) for r in records}
    for number in _highest(broken):
        names = " and ".join(records[number].violations)
        yield number, f"violates {names}"
        if number > 0:
            yield number - 1, f"before a violation of {names}"
    for name in dict.fromkeys(name for r in records for name in r.relaxation):
        for number in _highest({r.number: r.relaxation.get(name, 0.0) for r in records}):
            amount = records[number].relaxation[name]
            yield number, f"{name} {'dropped' if amount == torch.inf else 'most relaxed'}"
    for name in dict.fromkeys(name for r in records for name in r.moved):
        for number in _highest({r.number: r.moved.get(name, 0.0) for r in records}):
            yield number, f"most moved by {name}"
    for number in _highest({r.number: 1 - r.allowed_before for r in records}):
        yield number, "fewest actions allowed"


def _highest(values: Mapping[int, float]) -> list[int]:
    """Return the few numbers of the highest values above 0, none close to a higher one."""
    chosen: list[int] = []
    for number in sorted(values, key=lambda n: (-values[n], n)):
        if values[number] <= 0 or len(chosen) == _MOST_OF_A_KIND:
            break
        if all(abs(number - other) > _ALIKE for other in chosen):
            chosen.append(number)
    return chosen


def record_table(
    records: Sequence[StepRecord], reasons: Sequence[str] = (), unit: str = "action units"
) -> str:
    """Return records as a text table.

    Args:
        records: The records of some steps.
        reasons: The reasons why each one is worth a look; none leaves the column out.
        unit: The unit of the distances between actions.
    """
    moved = list(dict.fromkeys(name for record in records for name in record.moved))
    relaxed = list(dict.fromkeys(name for record in records for name in record.relaxation))
    head = ["step", "reward", "allowed before", *(f"{name} moved" for name in moved)]
    head += [f"{name} relaxed" for name in relaxed]
    head += ["why"] if reasons else ["violations"]
    rows = [head]
    for i, record in enumerate(records):
        row = [str(record.number), f"{record.reward:.3f}", f"{100 * record.allowed_before:.0f} %"]
        row += [f"{record.moved.get(name, 0.0):.3f}" for name in moved]
        row += [f"{record.relaxation.get(name, 0.0):.3g}" for name in relaxed]
        rows.append([*row, reasons[i] if reasons else " and ".join(record.violations)])
    note = f"moved and relaxed in {unit}; allowed before: share of the policy's samples that"
    return f"{text_table(rows)}\n\n{note}\nthe constraints would allow without the flow"
