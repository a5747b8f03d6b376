"""What happened inside a flow policy in one step: as values, and put into sentences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from textwrap import fill
from typing import Literal

import torch
from torch import Tensor
from torch.linalg import vector_norm

from cnfp_torchrl.envs import NOTHING, Component, TaskView, numbered_components
from cnfp_torchrl.text_table import markdown_table, text_table
from cnfp_torchrl.visual.snapshot import FlowSnapshot

Effect = Literal["permissive", "restrictive", "relaxed", "dropped", "broken"]

Vector = tuple[float, ...]

_ACTION_UNITS = "action units"
_WIDTH = 100
"""Of a terminal, in columns."""

_DRAWS = 1024
_MOST_DIMENSIONS_TO_MEASURE = 3
_VISIBLE = 1e-4
"""Ways shorter than this share of the action bounds are rounding, or cannot be seen."""


@dataclass(frozen=True)
class ConstraintEffect:
    """What one constraint did in one step.

    Args:
        name: The name of the constraint.
        effect: The effect: ``permissive``, it changed no sample; ``restrictive``, it changed some;
            ``relaxed``, it cannot hold as stated and its set is widened; ``dropped``, it cannot
            hold here; ``broken``, the executed action lies outside its set.
        before: The executed action before its stage, None where it has none or the way is unknown.
        after: The executed action after its stage, or None.
        moved: The amount by which its stage moved the executed action, in action units, or None.
        share_moved: The share of the samples that its stage moved; None where it moves all of them.
        share_outside: The share of the samples that lie outside its set in the end.
        share_allowed: The share of the action bounds that its set allows; None in many dimensions.
        relaxation: The amount by which its set is widened; 0 where it holds, infinite where it is
            dropped.
        slack: The slack of the executed action in its set: inside by so much, outside where
            negative.
        sentence: The task's sentence about it in this state, or None.
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
        action: The executed action.
        latent: The sample of the Gaussian base that it came from; None where that is unknown.
        bounded: The action after the action bounds alone, None where the flow has no such stage.
        constraints: The constraints' effects in order of application, the last one with the highest
            priority.
        share_allowed: The share of the action bounds that all of them allow; None in many
            dimensions.
        share_allowed_before: The share of the policy's samples that the constraints that hold would
            allow without the flow.
        samples: The number of samples that the shares are of.
        situation: The environment's state in a sentence, or None.
        is_safe: Whether the flow keeps every constraint that it does not drop.
        components: The names and units of the action's components.
    """

    action: Vector
    latent: Vector | None
    bounded: Vector | None
    constraints: tuple[ConstraintEffect, ...]
    share_allowed: float | None
    share_allowed_before: float
    samples: int
    situation: str | None
    is_safe: bool
    components: tuple[Component, ...]

    def markdown(self) -> str:
        """Return it as Markdown with tables, for a viewer's panel."""
        tables = [markdown_table(rows) for rows in (self._effects(), self._stages()) if rows]
        parts = [f"**{self._headline()}**", self.situation, *tables, *self._sentences()]
        return "\n\n".join(part for part in parts if part) + "\n"

    def text(self) -> str:
        """Return it as plain text with aligned tables, for a terminal."""
        tables = [text_table(rows) for rows in (self._stages(), self._effects()) if rows]
        sentences = "\n".join(fill(sentence, _WIDTH) for sentence in self._sentences())
        situation = self.situation and fill(self.situation, _WIDTH)
        parts = [fill(self._headline(), _WIDTH), situation, *tables, sentences]
        return "\n\n".join(part for part in parts if part) + "\n"

    @property
    def unit(self) -> str:
        """The unit of distances between actions."""
        return unit_of(self.components)

    def _amount(self, amount: float) -> str:
        return f"{amount:.3g} {self.unit}"

    def _headline(self) -> str:
        effects = self.constraints
        phrases = [
            f"the {effect.name} constraint moved the action by {self._amount(effect.moved)}"
            for effect in effects
            if effect.effect in ("restrictive", "relaxed") and effect.moved
        ]
        phrases += [
            f"the {effect.name} constraint is relaxed by {self._amount(effect.relaxation)}"
            for effect in effects
            if effect.effect == "relaxed"
        ]
        phrases += [
            f"the {effect.name} constraint is dropped"
            for effect in effects
            if effect.effect == "dropped"
        ]
        phrases += [
            f"the action breaks the {effect.name} constraint by {self._amount(-effect.slack)}"
            for effect in effects
            if effect.effect == "broken"
        ]
        if not phrases:
            moved = "no constraint moved the action" if self.is_safe else ""
            phrases = [moved or "the action keeps every constraint"]
        sentence = "; ".join(phrases)
        return f"{sentence[0].upper()}{sentence[1:]}."

    def _stages(self) -> list[list[str]]:
        """Return the action's way: a row for each component, a column for each stage."""
        columns = [("base", self.latent), ("bounds", self.bounded)]
        columns += [(effect.name, effect.after) for effect in self.constraints]
        known = [(name, values) for name, values in columns if values is not None]
        known.append(("executed", self.action))
        rows = [["action", *(name for name, _ in known)]]
        for i, component in enumerate(self.components):
            rows.append([component.title, *(f"{values[i]:.3f}" for _, values in known)])
        return rows

    def _effects(self) -> list[list[str]]:
        """Return a row for each constraint, and one for all together."""
        if not self.constraints:
            return []

        def allowed(cell: str) -> list[str]:
            return [] if self.share_allowed is None else [cell]

        rows = [["constraint", "effect", f"moved ({self.unit})", "samples moved"]]
        rows[0] += [*allowed("allows"), f"slack ({self.unit})"]
        for effect in self.constraints:
            moved = "" if effect.moved is None else f"{effect.moved:.3f}"
            share = allowed(_percent(effect.share_allowed))
            row = [effect.name, effect.effect, moved, _percent(effect.share_moved), *share]
            rows.append([*row, f"{effect.slack:.3f}"])
        if self.share_allowed is not None:
            rows.append(["together", "", "", "", _percent(self.share_allowed), ""])
        return rows

    def _sentences(self) -> list[str]:
        sentences = [f"{self._verdict(x)} {x.sentence or ''}".rstrip() for x in self.constraints]
        if self.constraints and self.is_safe:
            share = _percent(self.share_allowed_before)
            sentences.append(f"Without the flow, {share} of the samples would be allowed.")
        return sentences

    def _verdict(self, effect: ConstraintEffect) -> str:
        subject = f"The {effect.name} constraint"
        if effect.effect in ("dropped", "relaxed"):
            names = [other.name for other in self.constraints if other.effect != "dropped"]
            order = [other.name for other in self.constraints]
            higher = [name for name in names if order.index(name) > order.index(effect.name)]
            others = f" together with {_listed(higher)}" if higher else ""
            reason = f"no action within the bounds keeps it{others}"
            if effect.effect == "dropped":
                return f"{subject} is dropped: {reason}."
            return f"{subject} is relaxed by {self._amount(effect.relaxation)}: {reason}."
        if effect.effect == "broken":
            samples = f"{_percent(effect.share_outside)} of the samples do"
            return (
                f"The action breaks the {effect.name} constraint by {self._amount(-effect.slack)}; "
                f"{samples}."
            )
        if effect.effect == "permissive":
            return f"{subject} moved none of {self.samples} samples."
        if effect.share_moved is None:
            return (
                f"{subject} is kept: the action lies {self._amount(effect.slack)} inside its set."
            )
        samples = f"{_percent(effect.share_moved)} of {self.samples} samples"
        if effect.before is None or effect.after is None:
            return f"{subject} moved {samples}; the way of the action itself is unknown."
        if effect.moved:
            return f"{subject} moved the action by {self._amount(effect.moved)}, and {samples}."
        return f"{subject} left the action where it was, and moved {samples}."


def explain(
    snapshot: FlowSnapshot, view: TaskView = NOTHING, components: Sequence[Component] = ()
) -> Explanation:
    """Explain what a flow policy did in one step.

    Args:
        snapshot: The snapshot of the step; the followed sample is the executed one.
        view: The task's view, which says what it knows about the state, in sentences.
        components: The names and units of the action's components; none numbers them.
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
        share_allowed_before=snapshot.share_allowed_before,
        samples=len(snapshot.latents),
        situation=view.situation(snapshot.state),
        is_safe=snapshot.is_safe,
        components=tuple(components) or numbered_components("a", snapshot.dim),
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
    allowed = [constraint.contains(spread) for constraint in snapshot.region.sets[1:]]
    return torch.stack(allowed) if allowed else torch.ones(0, _DRAWS, dtype=torch.bool)


@cache
def _evenly_spread(dim: int) -> Tensor:
    return torch.quasirandom.SobolEngine(dim, scramble=True, seed=0).draw(_DRAWS)


def _share(mask: Tensor) -> float:
    return float(mask.double().mean())


def _plain(vector: Tensor) -> Vector:
    return tuple(vector.tolist())


def unit_of(components: Sequence[Component]) -> str:
    """Return the unit of distances between actions: that of all components, if they have one."""
    units = {component.unit for component in components}
    return units.pop() or _ACTION_UNITS if len(units) == 1 else _ACTION_UNITS


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
