"""The storage of states in a replay buffer, once a state instead of twice a transition."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import prod
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import Transform

STATE_KEY = "state"
"""The key of a stored transition's pointers to its two states, which replace their entries."""

POINTER_BYTES = 12
"""The size of the pointers by which a transition finds its two states."""


class _Field(NamedTuple):
    """The position of an entry in the bytes of a state."""

    key: NestedKey
    dtype: torch.dtype
    shape: torch.Size
    start: int
    stop: int


class PackedStates(Transform):
    """Keeps entries of states outside of a replay buffer's storage, each state once.

    The next state of a transition is the root of the following one, unless the episode has ended.
    A transition therefore stores two pointers (`POINTER_BYTES`) into a ring of states, in which all
    entries of a state are one row of bytes, looked up together when transitions are sampled. A
    state is shared where the root of a transition equals, byte by byte, the next state of the one
    before it in the same batch, or at the same index of the batch before, as collectors yield them;
    other orders are as correct, but store more.

    States are dropped when no stored transition can refer to them any more. This requires that the
    buffer overwrites its oldest transitions first, as TorchRL's default writer does.

    Args:
        keys: The entries' keys, at the root and under ``next``.
        max_size: The number of transitions that the buffer holds.
    """

    def __init__(self, keys: Sequence[NestedKey], max_size: int) -> None:
        super().__init__()
        self._keys = list(keys)
        self._max_size = max_size
        self._fields: list[_Field] = []
        self._rows: Tensor | None = None
        self._before: Tensor | None = None
        # The number of transitions and the oldest state of each batch in the buffer, oldest first.
        self._batches: deque[tuple[int, int]] = deque()
        self._stored = 0
        self._batch_start = self._end = 0

    @property
    def nbytes(self) -> int:
        """The bytes of all states that stored transitions can refer to."""
        if self._rows is None:
            return 0
        return (self._end - self._batches[0][1]) * self._rows.shape[-1]

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Take the entries out of transitions ``(batch,)`` that are to be stored."""
        root, after = self._packed(tensordict), self._packed(tensordict.get("next"))
        count = len(root)
        number = torch.arange(count, device=root.device)
        # Positions among the new states of this batch: its next states, then roots that are new.
        position = torch.full_like(number, -1)
        if self._before is not None and len(self._before) == count:
            same = (root == self._before).all(-1)
            position = torch.where(same, number - (self._end - self._batch_start), position)
            known = same
        else:
            known = torch.zeros_like(number, dtype=torch.bool)
        follows = torch.zeros_like(known)
        follows[1:] = (root[1:] == after[:-1]).all(-1)
        position = torch.where(follows & ~known, number - 1, position)
        new = ~(known | follows)
        position[new] = count + torch.arange(int(new.sum()), device=root.device)
        start = self._append(torch.cat([after, root[new]]), count)
        self._before = after
        packed = tensordict.exclude(*self._keys, *(_under_next(key) for key in self._keys))
        packed[STATE_KEY, "root"] = start + position
        packed[STATE_KEY, "step"] = (number - position).to(torch.int32)
        return packed

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the entries of the states into sampled transitions."""
        assert self._rows is not None
        pointers = tensordict.pop(STATE_KEY)
        root = pointers["root"]
        states = torch.stack([root, root + pointers["step"]]) % len(self._rows)
        rows = self._rows[states]
        outcome = tensordict.get("next")
        for key, dtype, shape, start, stop in self._fields:
            first, second = rows[..., start:stop].view(dtype).unflatten(-1, shape or (1,))
            tensordict.set(key, first if shape else first.squeeze(-1))
            outcome.set(key, second if shape else second.squeeze(-1))
        return tensordict

    def get_extra_state(self) -> dict[str, Any]:
        return {key: self.__dict__[key] for key in _STATE}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)

    def _packed(self, state: TensorDictBase) -> Tensor:
        """Return the entries of states as rows of bytes."""
        if not self._fields:
            self._fields = _layout({key: state.get(key) for key in self._keys})
        parts = []
        for key, dtype, *_ in self._fields:
            value = state.get(key)
            if value.dtype != dtype:
                raise ValueError(
                    f"key {key!r}: expected {dtype}, as in the transitions before, given "
                    f"{value.dtype}"
                )
            flat = value.reshape(len(value), -1).contiguous()
            parts.append(flat.view(torch.uint8))
        # Rows are aligned to the widest dtype, which comes first.
        padding = -self._fields[-1].stop % self._fields[0].dtype.itemsize
        parts.append(parts[0].new_zeros(len(parts[0]), padding))
        return torch.cat(parts, -1)

    def _append(self, rows: Tensor, count: int) -> int:
        """Write the new states of a batch of transitions and return the first one's number."""
        start, oldest = self._end, self._batch_start
        self._batches.append((count, oldest))
        self._stored += count
        while self._stored - self._batches[0][0] >= self._max_size:
            self._stored -= self._batches.popleft()[0]
        self._batch_start, self._end = start, start + len(rows)
        first = self._batches[0][1]
        if self._rows is None:
            # Enough for episodes of 8 steps and longer; memory that is not written takes no room.
            size = self._max_size + self._max_size // 8 + 2 * len(rows)
            self._rows = rows.new_empty(size, rows.shape[-1])
        if self._end - first > len(self._rows):
            kept = torch.arange(first, start, device=rows.device)
            larger = rows.new_empty(2 * (self._end - first), rows.shape[-1])
            larger[kept % len(larger)] = self._rows[kept % len(self._rows)]
            self._rows = larger
        new = torch.arange(start, self._end, device=rows.device)
        self._rows[new % len(self._rows)] = rows
        return start


_STATE = ("_fields", "_rows", "_before", "_batches", "_stored", "_batch_start", "_end")


def _layout(entries: dict[NestedKey, Tensor]) -> list[_Field]:
    """Return where entries stand, those of the widest dtype first, so that all are aligned."""
    fields, stop = [], 0
    for key in sorted(entries, key=lambda key: -entries[key].dtype.itemsize):
        value = entries[key]
        start, shape = stop, value.shape[1:]
        stop += prod(shape) * value.dtype.itemsize
        fields.append(_Field(key, value.dtype, shape, start, stop))
    return fields


def _under_next(key: NestedKey) -> NestedKey:
    return ("next", *((key,) if isinstance(key, str) else key))
