"""What has to be observed outside of an environment, for what is read inside of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import torch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs import CatTensors, EnvBase, Transform

from cnfp_torchrl.envs.geometry_transform import GeometryTransform
from cnfp_torchrl.keys import CONSTRAINTS_KEY
from cnfp_torchrl.modules import appended_transforms


@dataclass(frozen=True)
class ObservedEntry:
    """An entry that is observed itself, or concatenated from parts by TorchRL's `CatTensors`.

    Args:
        key: The entry's key; the first part may have the same.
        spec: The entry's spec for one state.
        parts: The entries that it is concatenated from, in order; none if it is observed itself.
    """

    key: NestedKey
    spec: TensorSpec
    parts: tuple[ObservedEntry, ...] = ()

    def leaf_specs(self) -> dict[NestedKey, TensorSpec]:
        """Return the specs of the entries that are observed themselves, by their keys."""
        return leaf_specs(self.parts) if self.parts else {self.key: self.spec}

    def value(self, find: Callable[[ObservedEntry], Tensor | None]) -> Tensor:
        """Return the entry's value, ``(*batch, *event)``.

        Args:
            find: Returns the value of an entry, or None for one that its parts are to make.
        """
        found = find(self)
        return torch.cat([part.value(find) for part in self.parts], -1) if found is None else found

    def split(self, value: Tensor) -> dict[NestedKey, Tensor]:
        """Return what was observed for a value, by its keys."""
        if not self.parts:
            return {self.key: value}
        pieces = value.split([part.spec.shape[-1] for part in self.parts], -1)
        split = [part.split(piece) for part, piece in zip(self.parts, pieces, strict=True)]
        return {key: observed for part in split for key, observed in part.items()}


def observed_entries(env: EnvBase, keys: Iterable[NestedKey]) -> list[ObservedEntry]:
    """Return entries that an environment publishes, each with what it is concatenated from.

    Args:
        env: The environment; it is not stepped.
        keys: The entries' keys; those of constraints, which are not observed, are left out.
    """
    transforms = appended_transforms(env)
    return [
        _entry(env, transforms, len(transforms), key)
        for key in dict.fromkeys(keys)
        if not (isinstance(key, tuple) and key[0] == CONSTRAINTS_KEY)
    ]


def leaf_specs(entries: Iterable[ObservedEntry]) -> dict[NestedKey, TensorSpec]:
    """Return the specs for one state of what is observed itself, by keys, in order."""
    return {key: spec for entry in entries for key, spec in entry.leaf_specs().items()}


def _entry(
    env: EnvBase, transforms: Sequence[Transform], end: int, key: NestedKey
) -> ObservedEntry:
    """Return an entry as it is before a transform of the environment."""
    source = env if end == len(transforms) else transforms[end].parent
    whole = source.observation_spec[key]
    spec = whole[(0,) * len(env.batch_size)]
    writers = [i for i, transform in enumerate(transforms[:end]) if key in transform.out_keys]
    if not writers or not isinstance(last := transforms[writers[-1]], CatTensors):
        return ObservedEntry(key, spec)
    later = {k for transform in transforms[writers[-1] + 1 :] for k in transform.out_keys}
    if last.dim != -1 or later.intersection(last.in_keys):  # then a key does not say which value
        return ObservedEntry(key, spec)
    parts = (_entry(env, transforms, writers[-1], part) for part in last.in_keys)
    return ObservedEntry(key, spec, tuple(parts))


def refuse_changed_inputs(env: EnvBase, keys: Sequence[NestedKey]) -> None:
    """Refuse transforms by which geometry and network read other values under the same key.

    Args:
        env: The environment.
        keys: The keys of what is observed.

    Raises:
        ValueError: naming the transform and the keys that it changes behind the geometries.
    """
    behind = False
    for transform in appended_transforms(env):
        behind = behind or isinstance(transform, GeometryTransform)
        changed = [key for key in transform.out_keys if key in keys]
        if behind and changed and not isinstance(transform, GeometryTransform):
            raise ValueError(
                f"env: expected no transform that changes {changed} behind the geometries, which "
                f"read them, given {type(transform).__name__}; put it into the environment that is "
                "constrained, or into the network"
            )
