"""All geometry of a step and the first attempts at the anchor, as one compiled function."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from cnfp_torchrl.envs.geometry_transform import GeometryTransform, are_good
from cnfp_torchrl.geometry import Anchored, Begun, Box, ConstraintSet, begin_anchor
from cnfp_torchrl.keys import ANCHOR_KEY, SAFE_ACTION_KEY
from cnfp_torchrl.modules import ConstraintBijector


class CompiledGeometry:
    """Publish the sets of all constraints and begin to look for the anchor, in one graph.

    Compiled at the first call, and again for another batch size or dtype. What depends on shapes
    alone is not checked: the geometries have done so at the reset before.

    Args:
        geometries: The transforms of the constraints, in order.
        bijectors: One for each constraint, in order of application.
        bounds: The action bounds.
    """

    def __init__(
        self,
        geometries: Sequence[GeometryTransform],
        bijectors: Sequence[ConstraintBijector],
        bounds: Box,
    ) -> None:
        self.geometries, self.bounds, self._bijectors = list(geometries), bounds, bijectors
        published = {geometry.name for geometry in geometries}
        keys = [key for geometry in geometries for key in geometry.in_keys]
        keys += [key for b in bijectors if b.name not in published for key in b.geometry_keys]
        self._keys = list(dict.fromkeys([*keys, SAFE_ACTION_KEY]))
        self._compiled = torch.compile(  # type: ignore[call-overload]  # unknown to its overloads
            self._computed, dynamic=False, isolate_recompiles=True
        )

    def __call__(self, states: TensorDictBase) -> tuple[Begun, Tensor]:
        """Publish the sets in some states, and anchors for the case that all of them are found.

        Returns:
            What the search for the anchor goes on from, without the `sets`, and whether all states
            are decided and all values as they must be, boolean ``(2,)``.
        """
        inputs = {key: states.get(key, None) for key in self._keys}
        published, begun, flags = self._compiled(inputs, states.batch_size)
        for key, value in published.items():
            states.set(key, value)
        return begun, flags

    def refuse(self, states: TensorDictBase) -> None:
        """Raise what is wrong with values in some states, as the geometries do."""
        for geometry in self.geometries:
            if geometry.validate:
                geometry.check(states, geometry.checked_set(states)).refuse()

    def _computed(
        self, inputs: dict[NestedKey, Tensor | None], batch: torch.Size
    ) -> tuple[dict[NestedKey, Tensor], Begun, Tensor]:
        states = TensorDict({}, batch)
        for key, value in inputs.items():
            if value is not None:
                states.set(key, value)
        published: dict[NestedKey, Tensor] = {}
        checks = []
        for geometry in self.geometries:
            allowed = geometry.checked_set(states)
            for key, value in geometry.published(states, allowed).items():
                states.set(key, value)
                published[key] = value
            if geometry.validate:
                checks.append(geometry.check(states, allowed))
        sets, candidate = self.sets(states), states.get(SAFE_ACTION_KEY, None)
        if candidate is not None:
            candidate = candidate.to(self.bounds.dtype)
        begun = begin_anchor(sets, candidate)
        published.update(anchor_entries(begun.all_held(), self._bijectors, batch))
        decided = begun.attempt.decided.all()
        good = are_good(checks) if checks else torch.ones_like(decided)
        return published, begun._replace(sets=()), torch.stack([decided, good])

    def sets(self, states: TensorDictBase) -> list[ConstraintSet]:
        """Return the action bounds and the published sets, in order of application."""
        found = (bijector.get_set(states) for bijector in self._bijectors)
        return [self.bounds, *(each.to(self.bounds.dtype) for each in found)]


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
