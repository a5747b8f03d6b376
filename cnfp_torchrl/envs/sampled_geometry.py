"""Sets of stored transitions, computed at sampling instead of being stored."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import prod

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase, Transform

from cnfp_torchrl.envs.geometry_transform import GeometryTransform
from cnfp_torchrl.envs.packed_states import POINTER_BYTES, RARE_BYTES
from cnfp_torchrl.keys import CONSTRAINTS_KEY, field_key
from cnfp_torchrl.modules import appended_transforms, constraint_bijectors


class SampledGeometry(Transform):
    """Compute constraints' sets in a replay buffer, at the root and under ``next`` in one pass.

    The environment published the same sets in the same states, and checked them: nothing is checked
    again, so that on a GPU nothing waits. Anchor and flags are not computed here, but to be stored.

    Args:
        env: The environment whose transforms publish the sets.
        names: The names of the constraints whose sets are computed.

    Raises:
        KeyError: for a name that none of the environment's geometry transforms has.
    """

    def __init__(self, env: EnvBase, names: Iterable[str]) -> None:
        super().__init__()
        geometries = _geometries(env)
        self._geometries = [geometries[name] for name in names]
        fields = _fields(env) if self._geometries else {}
        self.field_keys: list[NestedKey] = [
            key for geometry in self._geometries for key in fields[geometry.name]
        ]
        """The keys of the sets' fields, which need not be stored."""
        self.state_keys: list[NestedKey] = list(
            dict.fromkeys(key for geometry in self._geometries for key in geometry.in_keys)
        )
        """The keys of the entries of a state that have to be stored."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the sets' fields of sampled transitions."""
        parts = tensordict, tensordict.get("next")
        states = torch.stack([part.select(*self.state_keys) for part in parts])
        for geometry in self._geometries:
            allowed = geometry.checked_set(states)
            for field, value in allowed.fields().items():
                event = value.shape[value.ndim - allowed.event_dims[field] :]
                key = field_key(geometry.name, field)
                values = value.expand(*states.shape, *event)
                for part, entry in zip(parts, values, strict=True):
                    part.set(key, entry)
        return tensordict


def constraints_to_sample(env: EnvBase, keys: Sequence[NestedKey], limit: int) -> list[str]:
    """Return the constraints whose sets are computed at sampling because storing takes too much.

    The entries of ``constraints`` that an actor reads are stored once a state (`PackedStates`).
    Sets are stored, the largest first, where all that is stored fits the limit, because looking up
    takes less time than computing. Anchor, flags and relaxations, which take longest to compute,
    are always stored, even where they alone exceed the limit.

    Args:
        env: The environment whose transforms publish the geometry.
        keys: The keys that the actor reads of a state.
        limit: The largest number of bytes of a stored transition for constraints.
    """
    spec = env.observation_spec
    sizes = {
        key: prod(spec[key].shape[spec.ndim :]) * spec[key].dtype.itemsize
        for key in keys
        if isinstance(key, tuple) and key[0] == CONSTRAINTS_KEY
    }
    fields = _fields(env) if _geometries(env) else {}
    sets = {name: sum(sizes.pop(key, 0) for key in fields[name]) for name in fields}
    amounts = [sizes.pop(key) for key in amounts_keys(env) if key in sizes]
    stored = POINTER_BYTES + sum(sizes.values()) + (RARE_BYTES if amounts else 0)
    sampled = []
    for name in sorted(sets, key=lambda name: -sets[name]):
        if stored + sets[name] <= limit:
            stored += sets[name]
        else:
            sampled.append(name)
    return sampled


def amounts_keys(env: EnvBase) -> list[NestedKey]:
    """Return the keys of constraints' relaxations, which are 0 in most states."""
    publishes = bool(_geometries(env))
    return [b.amounts_key for b in constraint_bijectors(env)] if publishes else []


def _geometries(env: EnvBase) -> dict[str, GeometryTransform]:
    appended = appended_transforms(env)
    return {t.name: t for t in appended if isinstance(t, GeometryTransform)}


def _fields(env: EnvBase) -> dict[str, list[NestedKey]]:
    return {b.name: b.geometry_keys for b in constraint_bijectors(env)}
