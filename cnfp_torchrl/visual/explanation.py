"""What happened inside a flow policy in one step: as values, and put into sentences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import torch
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.envs import NOTHING, TaskView
from cnfp_torchrl.text_table import text_table
from cnfp_torchrl.visual.snapshot import FlowSnapshot

Effect = Literal["permissive", "restrictive", "relaxed", "dropped", "broken"]

Vector = tuple[float, ...]

_DRAWS = 1024
_MOST_DIMENSIONS_TO_MEASURE = 3
_VISIBLE = 1e-4
"""Ways shorter than this share of the action bounds are rounding, or cannot be seen."""


@dataclass(frozen=True)
class ConstraintEffect:
    """What one constraint did in one step.

    Args:
        name: of the constraint.
        effect: ``permissive``, it changed no sample; ``restrictive``, it changed some; ``relaxed``,
            it cannot hold as stated and its set is widened; ``dropped``, it cannot hold here;
            ``broken``, the executed action lies outside its set.
        before: the executed action before its stage, None where it has none or the way is unknown.
        after: the executed action after its stage, or None.
        moved: by how much its stage moved the executed action, in action units, or None.
        share_moved: of the samples, how many its stage moved; None where it moves all of them.
        share_outside: of the samples, how many lie outside its set in the end.
        share_allowed: of the action bounds, how much its set allows; None in many dimensions.
        relaxation: by how much its set is widened; 0 where it holds, infinite where it is dropped.
        slack: of the executed action in its set: inside by so much, outside where negative.
        sentence: what the task says about it in this state, or None.
    """

    name: str
    effect: Effect
    before: Vector | None
    after: Vector | None
    moved: float | None
    share_moved: float | None
    share_outside: float
    share_allowed: float | None
    relaxation: float
    slack: float
    sentence: str | None


@dataclass(frozen=True)
class Explanation:
    """What a flow policy did in one step; `markdown` and `text` put it into sentences.

    Args:
        action: the executed one.
        latent: the sample of the Gaussian base that it came from; None where that is unknown.
        bounded: the action after the action bounds alone, None where the flow has no such stage.
        constraints: their effects in order of application, the last one with the highest priority.
        share_allowed: of the action bounds, how much all of them allow; None in many dimensions.
        samples: how many samples the shares are of.
        situation: the environment's state in a sentence, or None.
        is_safe: whether the flow keeps every constraint that it does not drop.
    """

    action: Vector
    latent: Vector | None
    bounded: Vector | None
    constraints: tuple[ConstraintEffect, ...]
    share_allowed: float | None
    samples: int
    situation: str | None
    is_safe: bool

    def markdown(self) -> str:
        """Return it as Markdown with a table, for a viewer's panel."""
        head, *rows = self._table()
        table = [head, ["---"] * len(head), *([_escaped(cell) for cell in row] for row in rows)]
        lines = ["| " + " | ".join(row) + " |" for row in table]
        parts = [
            f"**{self._headline()}**",
            self.situation,
            "\n".join(lines),
            *self._sentences("**"),
        ]
        return "\n\n".join(part for part in parts if part) + "\n"

    def text(self) -> str:
        """Return it as plain text with an aligned table, for a terminal."""
        table = text_table(self._table())
        parts = [self._headline(), self.situation, table, "\n".join(self._sentences(""))]
        return "\n\n".join(part for part in parts if part) + "\n"

    def _headline(self) -> str:
        moved = [
            each
            for each in self.constraints
            if each.effect in ("restrictive", "relaxed") and each.moved
        ]
        said = [f"{each.name} moved the executed action by {each.moved:.3f}" for each in moved]
        said += [
            f"{each.name} is relaxed by {each.relaxation:.3g}"
            for each in self.constraints
            if each.effect == "relaxed"
        ]
        said += [
            f"{each.name} is {each.effect}"
            for each in self.constraints
            if each.effect in ("dropped", "broken")
        ]
        if not said and self.is_safe:
            said = ["no constraint changed the executed action"]
        elif not said:
            said = ["the executed action keeps every constraint"]
        return _capitalized("; ".join(said)) + "."

    def _table(self) -> list[list[str]]:
        rows = [["stage", "executed action", "moved", "samples moved", "allows", "effect"]]
        if self.latent is not None:
            rows.append(["base", _vector(self.latent), "", "", "", ""])
        if self.bounded is not None:
            rows.append(["bounds", _vector(self.bounded), "", "", "100 %", ""])
        for each in self.constraints:
            moved = "" if each.moved is None else f"{each.moved:.3f}"
            after = "" if each.after is None else _vector(each.after)
            shares = [_percent(each.share_moved), _percent(each.share_allowed)]
            rows.append([each.name, after, moved, *shares, each.effect])
        rows.append(["action", _vector(self.action), "", "", _percent(self.share_allowed), ""])
        return rows

    def _sentences(self, mark: str) -> list[str]:
        return [
            f"{mark}{each.name}{mark}: {self._verdict(each)} {each.sentence or ''}".rstrip()
            for each in self.constraints
        ]

    def _verdict(self, each: ConstraintEffect) -> str:
        if each.effect in ("dropped", "relaxed"):
            names = [other.name for other in self.constraints if other.effect != "dropped"]
            order = [other.name for other in self.constraints]
            higher = [name for name in names if order.index(name) > order.index(each.name)]
            others = f" together with {_listed(higher)}" if higher else ""
            reason = f"no action within the bounds keeps it{others}"
            if each.effect == "dropped":
                return f"dropped, {reason}."
            return f"relaxed, {reason}: its set is widened by {each.relaxation:.3g}."
        if each.effect == "broken":
            where = f"the executed action lies outside its set by {-each.slack:.3g}"
            return f"broken, {where}, with {_percent(each.share_outside)} of the samples."
        allows = "" if each.share_allowed is None else f" It allows {_percent(each.share_allowed)}"
        allows += " of the action bounds." if allows else ""
        if each.effect == "permissive":
            return f"permissive, it changed none of {self.samples} samples.{allows}"
        if each.share_moved is None:
            return f"restrictive, the executed action lies {each.slack:.3f} inside.{allows}"
        if each.before is None or each.after is None:
            did = "the way of the executed action is unknown"
        elif each.moved:
            did = f"it moved the executed action from {_vector(each.before)} by {each.moved:.3f}"
        else:
            did = "it left the executed action as it was"
        samples = f"{_percent(each.share_moved)} of {self.samples} samples"
        return f"restrictive, {did}, and moved {samples}.{allows}"


def explain(snapshot: FlowSnapshot, view: TaskView = NOTHING) -> Explanation:
    """Explain what a flow policy did in one step.

    Args:
        snapshot: of the step; the followed sample is the executed one.
        view: says what the task knows about the state, in sentences.
    """
    sentences = view.constraint_sentences(snapshot.state)
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
            sentences.get(name),
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
        situation=view.situation(snapshot.state),
        is_safe=snapshot.is_safe,
    )


def _effect(
    snapshot: FlowSnapshot,
    index: int,
    stage: int | None,
    action: Tensor,
    path: Tensor | None,
    share_allowed: float | None,
    sentence: str | None,
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
    elif snapshot.is_safe and snapshot.relaxation[index] > 0:
        effect = "relaxed"
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
        relaxation=snapshot.relaxation[index],
        slack=float(allowed.to(torch.float64).slack(action.double())),
        sentence=sentence,
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


def _vector(values: Sequence[float]) -> str:
    return "(" + ", ".join(f"{value:.3f}" for value in values) + ")"


def _percent(share: float | None) -> str:
    """Return a share, never rounding what is there to nothing or to everything."""
    if share is None:
        return ""
    if 0 < share < 0.005:
        return "< 1 %"
    if 0.995 <= share < 1:
        return "> 99 %"
    return f"{100 * share:.0f} %"


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _capitalized(sentence: str) -> str:
    return sentence[0].upper() + sentence[1:]


def _escaped(cell: str) -> str:
    return cell.replace("|", "\\|")
