"""All geometry of a step and the first attempts at the anchor, in one pass, compiled or not."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from cnfp_torchrl.envs.geometry_transform import (
    Check,
    GeometryTransform,
    evidence,
    refuse_values,
    write_entries,
)
from cnfp_torchrl.geometry import (
    Anchored,
    Begun,
    Box,
    ConstraintSet,
    GeometryError,
    are_within,
    begin_anchor,
    continue_anchor,
)
from cnfp_torchrl.keys import ANCHOR_KEY, SAFE_ACTION_KEY
from cnfp_torchrl.modules import ConstraintBijector

_MOST_STEPPED = 512
"""The largest batch in which steps inwards in all states take less time than finding some."""

_OF_OTHERS = re.compile(
    r"G\['__import_(?!(torch|torchrl|tensordict|cnfp_torchrl|typing|collections|math)(_dot_|'))"
)
"""Names of globals of other modules than these, as PyTorch's guards call them."""


class Step(NamedTuple):
    """What is known of the anchors in some states before any search.

    Attributes:
        begun: What a search goes on from; without sets where a compiled pass decided all states.
        is_decided: Whether all states need no search.
        is_published: Whether it is published already that all constraints hold.
    """

    begun: Begun
    is_decided: bool
    is_published: bool = False


class StepGeometry:
    """Publish the sets of all constraints and begin to look for the anchor.

    The sets go to the anchor as they are, and all that is to be known on the host, whether values
    are as they must be and whether a search is needed, is read at once: on a GPU each read waits.

    Compiled, it is one graph, made at the first call, and again for another batch size or dtype.
    What depends on shapes alone is then not checked: the geometries have done so at the reset. In
    small batches a second graph takes steps inwards, made at the first step that leaves a state
    undecided.

    Args:
        geometries: The transforms of the constraints that are published here, in order; none where
            all are published before.
        bijectors: One for each constraint, in order of application.
        bounds: The action bounds.
        compile: Whether to compile it.
    """

    def __init__(
        self,
        geometries: Sequence[GeometryTransform],
        bijectors: Sequence[ConstraintBijector],
        bounds: Box,
        *,
        compile: bool = False,
    ) -> None:
        self.geometries, self.bounds, self._bijectors = list(geometries), bounds, bijectors
        self._compiled = None
        if compile:
            published = {geometry.name for geometry in geometries}
            keys = [key for geometry in geometries for key in geometry.in_keys]
            keys += [key for b in bijectors if b.name not in published for key in b.geometry_keys]
            self._keys = list(dict.fromkeys([*keys, SAFE_ACTION_KEY]))
            self._set_keys = [key for b in bijectors for key in b.geometry_keys]
            self._compiled, self._compiled_steps = (
                torch.compile(  # type: ignore[call-overload]  # unknown to its overloads
                    function,
                    dynamic=False,
                    isolate_recompiles=True,
                    options={"guard_filter_fn": _those_that_may_change},
                )
                for function in (self._all_published, self._all_stepped)
            )

    def __call__(self, states: TensorDictBase) -> Step:
        """Publish the sets in some states.

        Raises:
            GeometryError: naming the constraint, for states or sets that are not as they must be.
        """
        if self._compiled is None:
            begun, checks, _ = self._begun(states)
            flags, limits = _flags(begun, checks)
        else:
            inputs = {key: states.get(key, None) for key in self._keys}
            published, begun, flags, limits = self._compiled(inputs, states.batch_size)
            write_entries(states, published)
            checks = []
        decided, *values = flags.tolist()
        if not are_within(values, limits):
            refuse_values(checks or self._checks(states))
        is_decided = bool(decided)
        if self._compiled is not None and not is_decided:
            begun = begun._replace(sets=self.sets(states))
            if states.numel() <= _MOST_STEPPED and begun.steps_may_help():
                sets = {key: states.get(key) for key in self._set_keys}
                published, after, flag = self._compiled_steps(sets, begun._replace(sets=()))
                begun, is_decided = after._replace(sets=begun.sets), bool(flag)
                write_entries(states, published)
        return Step(begun, is_decided, self._compiled is not None)

    def sets(self, states: TensorDictBase) -> list[ConstraintSet]:
        """Return the action bounds and the published sets, in order of application."""
        return self._with_bounds({}, states)

    def _begun(self, states: TensorDictBase) -> tuple[Begun, list[Check], dict[Any, Tensor]]:
        """Publish the sets, begin to look for the anchor, and return what is to be checked."""
        known, checks, published = {}, [], {}
        for geometry in self.geometries:
            allowed, entries = geometry.write_set(states)
            known[geometry.name] = allowed
            published.update(entries)
            if geometry.validate:
                checks.append(geometry.check(states, allowed))
        sets, candidate = self._with_bounds(known, states), states.get(SAFE_ACTION_KEY, None)
        if candidate is not None:
            candidate = candidate.to(self.bounds.dtype)
        return begin_anchor(sets, candidate), checks, published

    def _all_published(
        self, inputs: dict[NestedKey, Tensor | None], batch: torch.Size
    ) -> tuple[dict[NestedKey, Tensor], Begun, Tensor, list[float]]:
        """Return what is published where all constraints hold, and what `_begun` does."""
        states = TensorDict({}, batch)
        write_entries(states, {k: value for k, value in inputs.items() if value is not None})
        begun, checks, published = self._begun(states)
        published.update(anchor_entries(begun.all_held(), self._bijectors, batch))
        return published, begun._replace(sets=()), *_flags(begun, checks)

    def _all_stepped(
        self, sets: dict[NestedKey, Tensor], before: Begun
    ) -> tuple[dict[NestedKey, Tensor], Begun, Tensor]:
        """Return what is published where all constraints hold, after steps inwards."""
        batch = before.attempt.decided.shape
        states = TensorDict({}, batch)
        write_entries(states, sets)
        begun = continue_anchor(before._replace(sets=self.sets(states)))
        published = anchor_entries(begun.all_held(), self._bijectors, batch)
        return published, begun._replace(sets=()), begun.attempt.decided.all()

    def _checks(self, states: TensorDictBase) -> list[Check]:
        """Return what is to be checked of states for which the compiled pass did not say it."""
        checked = (geometry for geometry in self.geometries if geometry.validate)
        return [geometry.check(states, geometry.checked_set(states)) for geometry in checked]

    def _with_bounds(
        self, known: dict[str, ConstraintSet], states: TensorDictBase
    ) -> list[ConstraintSet]:
        # In the dtype of the actions, as the flow will see them.
        sets: list[ConstraintSet] = [self.bounds]
        for bijector in self._bijectors:
            allowed = known.get(bijector.name)
            allowed = bijector.get_set(states) if allowed is None else allowed
            if allowed.dim != self.bounds.dim:
                raise GeometryError(
                    f"constraint '{bijector.name}': expected a set of actions with "
                    f"{self.bounds.dim} components, as the action spec has, given one with "
                    f"{allowed.dim}"
                )
            sets.append(allowed.to(self.bounds.dtype))
        return sets


def _those_that_may_change(guards: Sequence[Any]) -> list[bool]:
    """Tell which guards of a compiled function are looked at in each call.

    Not those of what libraries and this one define, which are most and take most of the time of a
    call: of what constraints read, their own attributes and their modules' globals remain.
    """
    return [not guard.is_global or bool(_OF_OTHERS.match(guard.name)) for guard in guards]


def _flags(begun: Begun, checks: Sequence[Check]) -> tuple[Tensor, list[float]]:
    """Return whether all states are decided, and numbers with limits that tell of the values."""
    found = evidence(checks)
    flags = torch.stack([begun.attempt.decided.all(), *(evidence.value for evidence in found)])
    return flags, [evidence.limit for evidence in found]


def anchor_entries(
    found: Anchored, bijectors: Sequence[ConstraintBijector], batch: torch.Size
) -> dict[NestedKey, Tensor]:
    """Return anchor, active flags and relaxations as they are published.

    Args:
        found: What was found of the action bounds and all constraints.
        bijectors: One for each constraint, in order of application.
        batch: The batch size of the states.
    """
    entries: dict[NestedKey, Tensor] = {ANCHOR_KEY: _expanded(found.anchor, batch)}
    active = _expanded(found.active, batch).unbind(-1)
    for stage, bijector in enumerate(bijectors, start=1):
        rows = _expanded(found.relaxation[stage], batch)
        entries[bijector.active_key] = active[stage]
        entries[bijector.relaxation_key] = (
            rows.squeeze(-1) if rows.shape[-1] == 1 else rows.amax(-1)
        )
        if bijector.row_relaxation_key is not None:
            entries[bijector.row_relaxation_key] = rows
    return entries


def _expanded(value: Tensor, batch: torch.Size) -> Tensor:
    """Return values ``(..., m)`` as ``(*batch, m)``."""
    return value if value.shape[:-1] == batch else value.expand(*batch, value.shape[-1])
