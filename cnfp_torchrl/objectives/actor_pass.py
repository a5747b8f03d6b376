"""Distributions of an actor without its modules' bookkeeping, which costs more than its network.

tensordict 0.14 looks on disk for pandas at each entry that a TensorDictModule writes, which alone
takes longer than a small network does. Of modules that only call their network, the network is
therefore called here; any other actor is asked for its distribution as usual.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.modules import SafeModule, ValueOperator

from cnfp_torchrl.modules import ConstrainedFlowModule, ParameterNetwork, actor_modules

_PLAIN_MODULES = (TensorDictModule, ParameterNetwork, SafeModule, ValueOperator)

_BLOCK = 16
"""The size of the blocks in which torch's generator on a CPU fills tensors with normal numbers."""


def is_plain(module: nn.Module) -> bool:
    """Tell whether a module only calls its network on its in_keys and writes what that returns."""
    return (
        type(module) in _PLAIN_MODULES
        and module.method is None
        and module._kwargs is None
        and "_" not in module.out_keys
        and not (module._forward_hooks or module._forward_pre_hooks or module._backward_hooks)
    )


def distribution(
    actor: ProbabilisticTensorDictSequential, tensordict: TensorDictBase
) -> Distribution:
    """Return ``actor.get_dist(tensordict)``; the tensordict stays as it is."""
    *body, head = actor_modules(actor)
    if actor.return_composite or not all(map(is_plain, body)):
        return actor.get_dist(tensordict.copy())
    written = _written(body, tensordict)
    if not all(isinstance(key, str) for key in written):
        return actor.get_dist(tensordict.copy())
    # Entries that are tensordicts are shared, which is safe because only strings are written.
    entries = {**dict(tensordict.items()), **written}
    return head.get_dist(TensorDict(entries, tensordict.batch_size, tensordict.device))


def distribution_of_both(
    actor: ProbabilisticTensorDictSequential, first: TensorDictBase, second: TensorDictBase
) -> Distribution | None:
    """Return the distribution over actions in two batches of states at once, ``(2, *batch)``.

    The flow of a constrained actor consists of many operations on few numbers, which take as long
    for twice as many. The first states get no gradient from the actor's networks.

    Args:
        actor: Any actor.
        first: States ``(*batch,)``.
        second: Other states, as many.

    Returns:
        The distribution; None for an actor that is not constrained, and where samples would not be
        those of two draws, the first batch's before the second's.
    """
    *body, head = actor_modules(actor)
    is_constrained = isinstance(head, ConstrainedFlowModule)
    if not is_constrained or actor.return_composite or not all(map(is_plain, body)):
        return None
    with torch.no_grad():
        written = [_written(body, first)]
    written.append(_written(body, second))
    location = written[1].get(head.parameter_keys[0])
    if location is None or (location.device.type == "cpu" and location.numel() % _BLOCK):
        return None
    states = _Both((first, second), written)
    return head.get_dist(cast(TensorDictBase, states))


class _Both:
    """Two batches of states, each entry stacked when it is read.

    It has the part of a tensordict's interface that a `ConstrainedFlowModule` uses: stacking two
    tensordicts, with their nested ones, would take half as long as building the flow.
    """

    def __init__(
        self, parts: Sequence[TensorDictBase], written: Sequence[dict[NestedKey, Tensor]]
    ) -> None:
        self._parts, self._written = parts, written
        # The nested tensordicts of both, by their paths: to look up each entry by its whole path
        # takes as long as to stack it.
        self._nested: dict[tuple[str, ...], list[TensorDictBase | None]] = {(): [*parts]}
        self.shape = self.batch_size = torch.Size((2, *parts[0].batch_size))
        self.device = parts[0].device

    def get(self, key: NestedKey, default: Tensor | None = None) -> Tensor | None:
        if key in self._written[0]:
            return torch.stack([known[key] for known in self._written])
        *path, name = (key,) if isinstance(key, str) else key
        first, second = (_entry(part, name) for part in self._at(tuple(path)))
        return default if first is None or second is None else torch.stack((first, second))

    def _at(self, path: tuple[str, ...]) -> list[TensorDictBase | None]:
        """Return the tensordicts of both at a path, None where there is none."""
        if path not in self._nested:
            outer = self._at(path[:-1])
            self._nested[path] = [_entry(part, path[-1]) for part in outer]
        return self._nested[path]

    def keys(self, *args: Any, **kwargs: Any) -> Iterable[NestedKey]:
        return self._parts[1].keys(*args, **kwargs)


def _entry(tensordict: TensorDictBase | None, name: str) -> Any:
    return None if tensordict is None else tensordict.get(name, None)


def _written(body: list[TensorDictModule], tensordict: TensorDictBase) -> dict[NestedKey, Tensor]:
    """Return the entries that plain modules write, applied in order."""
    written: dict[NestedKey, Tensor] = {}
    for module in body:
        keys = module.in_keys
        inputs = (written[key] if key in written else tensordict.get(key) for key in keys)
        returned = module.module(*inputs)
        outputs = returned if isinstance(returned, tuple) else (returned,)
        written.update(zip(module.out_keys, outputs, strict=True))
    return written
