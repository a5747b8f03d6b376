"""Sets of stored transitions, computed at sampling instead of being stored."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import prod

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase, Transform

from cnfp_torchrl.envs.geometry_transform import GeometryTransform
from cnfp_torchrl.envs.packed_states import POINTER_BYTES
from cnfp_torchrl.keys import CONSTRAINTS_KEY, field_key
from cnfp_torchrl.modules import appended_transforms, constraint_bijectors


class SampledGeometry(Transform):
    """Computes constraints' sets in a replay buffer, at the root and under ``next`` in one pass.

    The sets are those that the environment published in the same states, where they were checked:
    nothing is checked again, and on a GPU nothing is waited for. Anchor and flags are no sets; they
    are to be stored.

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
            key for each in self._geometries for key in fields[each.name]
        ]
        """What need not be stored."""
        self.state_keys: list[NestedKey] = list(
            dict.fromkeys(key for each in self._geometries for key in each.in_keys)
        )
        """What has to be stored of each state."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the sets' fields of sampled transitions."""
        parts = tensordict, tensordict.get("next")
        states = torch.stack([each.select(*self.state_keys) for each in parts])
        for geometry in self._geometries:
            allowed = geometry.checked_set(states)
            for field, value in allowed.fields().items():
                event = value.shape[value.ndim - allowed.event_dims[field] :]
                key = field_key(geometry.name, field)
                for part, each in zip(parts, value.expand(*states.shape, *event), strict=True):
                    part.set(key, each)
        return tensordict


def constraints_to_sample(env: EnvBase, keys: Sequence[NestedKey], limit: int) -> list[str]:
    """Return the constraints whose sets are to be computed at sampling, to store few bytes.

    What an actor reads of ``constraints`` is stored once a state (`PackedStates`). The sets of a
    constraint are stored where all that is stored fits the limit, the largest sets first, because
    looking up takes less time than computing. Anchor, flags and relaxations, which take longest to
    compute, always are, even where they alone exceed the limit.

    Args:
        env: The environment whose transforms publish the geometry.
        keys: The keys that the actor reads of a state.
        limit: The bytes of a stored transition that may be for constraints.
    """
    spec = env.observation_spec
    sizes = {
        key: prod(spec[key].shape[spec.ndim :]) * spec[key].dtype.itemsize
        for key in keys
        if isinstance(key, tuple) and key[0] == CONSTRAINTS_KEY
    }
    fields = _fields(env) if _geometries(env) else {}
    sets = {name: sum(sizes.pop(key, 0) for key in fields[name]) for name in fields}
    stored, sampled = POINTER_BYTES + sum(sizes.values()), []
    for name in sorted(sets, key=lambda name: -sets[name]):
        if stored + sets[name] <= limit:
            stored += sets[name]
        else:
            sampled.append(name)
    return sampled


def _geometries(env: EnvBase) -> dict[str, GeometryTransform]:
    appended = appended_transforms(env)
    return {each.name: each for each in appended if isinstance(each, GeometryTransform)}


def _fields(env: EnvBase) -> dict[str, list[NestedKey]]:
    return {each.name: each.geometry_keys for each in constraint_bijectors(env)}
