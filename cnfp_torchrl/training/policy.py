"""A trained run as a function from observations to allowed actions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.envs import (
    GeometryTransform,
    ObservedEntry,
    appended_transforms,
    leaf_specs,
    observed_entries,
    refuse_changed_inputs,
)
from cnfp_torchrl.modules import ConstraintPublisher, flow_head, guarded
from cnfp_torchrl.training.agent import build_environment, load_actor
from cnfp_torchrl.training.run_folder import BEST, CHECKPOINT, RunFolder

Values = TypeVar("Values", Tensor, NDArray[np.floating])
"""Tensors, or NumPy's arrays."""


class TrainedPolicy:
    """A function from observations to actions that the constraints allow.

    It computes sets, anchor, network and flow, as training did, and asks no environment.

    Args:
        actor: The trained actor.
        env: The environment whose transforms publish the constraints; it is never stepped.
        deterministic: Whether the action is that of the mean, or drawn.
        refuse_relaxation: Whether to raise where a constraint gives way, whatever the action.
    """

    def __init__(
        self,
        actor: SafeProbabilisticTensorDictSequential,
        env: EnvBase,
        *,
        deterministic: bool = True,
        refuse_relaxation: bool = False,
    ) -> None:
        flow = flow_head(actor).flow
        self.actor, self.env = actor, env
        self._policy = guarded(actor, env, refuse_relaxation=refuse_relaxation)
        self._mode = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
        published = appended_transforms(env) if flow.reads_constraints else []
        self._publishers: list[Any] = [
            publisher for publisher in published if isinstance(publisher, ConstraintPublisher)
        ]
        read = [
            transform for transform in self._publishers if isinstance(transform, GeometryTransform)
        ]
        keys = [*(key for transform in read for key in transform.in_keys), *actor.in_keys]
        self._entries = observed_entries(env, keys)
        self.in_keys: list[NestedKey] = list(leaf_specs(self._entries))
        """The keys of what has to be observed: of a vector that `CatTensors` makes, its parts."""
        if self._publishers:
            refuse_changed_inputs(env, self.in_keys)

    def __call__(self, observation: Values | Mapping[NestedKey, Values]) -> Values:
        """Return an allowed action ``(*batch, d)`` for each observation.

        Args:
            observation: What the environment of training publishes, ``(*batch, n)``: an array, or
                where several entries are read (`in_keys`), a mapping with each of them, in which
                nested ones may stand in mappings of their own.

        Raises:
            TypeError: for an entry that is neither an array nor a tensor, nor a list of numbers.
            ValueError: for a missing entry, or one of another shape than the environment's.
            GeometryError: for numbers that are not finite.
            ConstraintViolationError: when the action is outside a set, which a network that
                returns NaN would cause; then nothing is returned that could be executed.
        """
        given = observation if isinstance(observation, Mapping) else {self._only_key(): observation}
        values = {entry.key: entry.value(partial(self._value, given)) for entry in self._entries}
        first = self._entries[0]
        batch = values[first.key].shape[: values[first.key].ndim - first.spec.ndim]
        state = TensorDict(values, batch_size=batch)
        with torch.no_grad(), set_exploration_type(self._mode):
            for publisher in self._publishers:
                state = publisher(state)
            action = self._policy(state).get(self.env.action_key)
        keys = [*self.in_keys, *(entry.key for entry in self._entries)]
        is_numpy = any(isinstance(_found(given, key), np.ndarray) for key in keys)
        return cast(Values, action.numpy() if is_numpy else action)

    def _only_key(self) -> NestedKey:
        if len(self._entries) > 1:
            raise ValueError(
                f"observation: expected a mapping with the entries {self.in_keys}, which networks "
                "and constraints read, given one array"
            )
        return self._entries[0].key

    def _value(self, given: Mapping[Any, Any], entry: ObservedEntry) -> Tensor | None:
        """Return an entry as it is given, None where its parts are to make it."""
        key, value, event = entry.key, _found(given, entry.key), tuple(entry.spec.shape)
        if value is None:
            if entry.parts:
                return None
            raise ValueError(
                f"observation: expected the entries {self.in_keys}, {key!r} is missing"
            )
        try:
            tensor = torch.as_tensor(value).to(entry.spec.dtype)
        except (TypeError, ValueError, RuntimeError):
            raise TypeError(
                f"observation, {key!r}: expected an array or a tensor of numbers, given {value!r}"
            ) from None
        if tuple(tensor.shape[max(tensor.ndim - len(event), 0) :]) == event:
            return tensor
        if entry.parts:  # the first of which may have the same key
            return None
        raise ValueError(
            f"observation, {key!r}: expected shape (*batch, {', '.join(map(str, event))}), as "
            f"the environment has it, given {tuple(tensor.shape)}"
        )


def _found(observation: Mapping[Any, Any], key: NestedKey) -> Any:
    """Return an entry by its key, or as Gymnasium nests it, ``observation["arm"]["angle"]``."""
    if isinstance(key, str) or key in observation:
        return observation.get(key)
    found: Any = observation
    for part in key:
        found = found.get(part) if isinstance(found, Mapping) else None
    return found


def load_policy(
    run: str | Path,
    *,
    best: bool = False,
    deterministic: bool = True,
    refuse_relaxation: bool = False,
    trusted: Sequence[str] = (),
) -> TrainedPolicy:
    """Return the policy of a run, guarded, on the CPU.

    Args:
        run: The folder that training printed when it ended.
        best: Whether to take the best policy of training in place of the last one.
        deterministic: Whether the action is that of the mean, or drawn.
        refuse_relaxation: Whether to raise in a state in which a constraint gives way.
        trusted: The packages, modules or objects that the run's configuration may name beside the
            shipped ones: ``["my_package."]``.

    Raises:
        TypeError: for a run that is no path.
        FileNotFoundError: when the folder holds no finished run, or no best policy.
        ValueError: when its files are broken or do not fit each other.
        PermissionError: when its configuration names what is not trusted.
    """
    if not isinstance(run, str | Path):
        raise TypeError(f"run: expected the path of a run's folder, given {run!r}")
    folder = RunFolder.open(run, BEST if best else CHECKPOINT)
    config = folder.load_config(trusted)
    env = build_environment(config, batch_size=[1])
    actor = load_actor(folder, config, env)
    return TrainedPolicy(
        actor, env, deterministic=deterministic, refuse_relaxation=refuse_relaxation
    )
