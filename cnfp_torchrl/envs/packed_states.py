"""The storage of states in a replay buffer, once a state instead of twice a transition."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from copy import deepcopy
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

RARE_BYTES = 4
"""The size of the pointer by which a state finds all of its rare entries."""

_RARE_KEY = (STATE_KEY, "rare")
"""The key of that pointer among a state's entries."""


class _Field(NamedTuple):
    """The position of an entry in the bytes of a state."""

    key: NestedKey
    dtype: torch.dtype
    shape: torch.Size
    start: int
    stop: int


class _Ring:
    """Rows of bytes, numbered as they come; the oldest ones are overwritten when they are dropped.

    Args:
        size: The number of rows that room is made for at first.
    """

    def __init__(self, size: int) -> None:
        self.size, self.end = size, 0
        self.rows: Tensor | None = None

    def append(self, rows: Tensor, oldest: int) -> int:
        """Keep rows behind those from the oldest on, and return the first one's number."""
        start, self.end = self.end, self.end + len(rows)
        if self.rows is None:
            self.rows = rows.new_empty(self.size + 2 * len(rows), rows.shape[-1])
        if self.end - oldest > len(self.rows):
            kept = torch.arange(oldest, start, device=rows.device)
            larger = rows.new_empty(2 * (self.end - oldest), rows.shape[-1])
            larger[kept % len(larger)] = self.rows[kept % len(self.rows)]
            self.rows = larger
        new = torch.arange(start, self.end, device=rows.device)
        self.rows[new % len(self.rows)] = rows
        return start

    def take(self, numbers: Tensor) -> Tensor:
        """Return the rows of some numbers."""
        assert self.rows is not None
        return self.rows[numbers % len(self.rows)]

    def nbytes(self, oldest: int) -> int:
        """Return the bytes of the rows from the oldest on."""
        return 0 if self.rows is None else (self.end - oldest) * self.rows.shape[-1]


class PackedStates(Transform):
    """Keep entries of states outside of a replay buffer's storage, each state once.

    The next state of a transition is the root of the following one, unless the episode has ended.
    A transition therefore stores two pointers (`POINTER_BYTES`) into a ring of states, in which all
    entries of a state are one row of bytes, looked up together when transitions are sampled. A
    state is shared where the root of a transition equals, byte by byte, the next state of the one
    before it in the same batch, or at the same index of the batch before, as collectors yield them;
    other orders are as correct, but store more.

    Entries that are zero in most states, such as relaxations, are kept in a ring of their own for
    the states in which one of them is not; other states take `RARE_BYTES` for all of them.

    States are dropped when no stored transition can refer to them any more. This requires that the
    buffer overwrites its oldest transitions first, as TorchRL's default writer does.

    Args:
        keys: The entries' keys, at the root and under ``next``.
        max_size: The number of transitions that the buffer holds.
        rare: The keys, among these, of the entries that are zero in most states.
    """

    def __init__(
        self, keys: Sequence[NestedKey], max_size: int, rare: Sequence[NestedKey] = ()
    ) -> None:
        super().__init__()
        self._rare_keys = [key for key in keys if key in rare]
        self._keys = [key for key in keys if key not in rare]
        self._max_size = max_size
        self._fields: list[_Field] = []
        self._rare_fields: list[_Field] = []
        # Enough for episodes of 8 steps and longer; memory that is not written takes no room.
        self._states, self._rare = _Ring(max_size + max_size // 8), _Ring(16)
        self._before: Tensor | None = None
        # The number of transitions, the oldest state and the oldest row of rare entries of each
        # batch in the buffer, oldest first.
        self._batches: deque[tuple[int, int, int]] = deque()
        self._stored = self._batch_start = self._batch_rare_start = 0

    @property
    def nbytes(self) -> int:
        """The bytes of all states that stored transitions can refer to."""
        if not self._batches:
            return 0
        _, oldest, oldest_rare = self._batches[0]
        return self._states.nbytes(oldest) + self._rare.nbytes(oldest_rare)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Take the entries out of transitions ``(batch,)`` that are to be stored."""
        root, after = self._packed(tensordict), self._packed(tensordict.get("next"))
        count = len(root)
        number = torch.arange(count, device=root.device)
        # Positions among the new states of this batch: its next states, then roots that are new.
        position = torch.full_like(number, -1)
        if self._before is not None and len(self._before) == count:
            same = (root == self._before).all(-1)
            before = number - (self._states.end - self._batch_start)
            position = torch.where(same, before, position)
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
        keys = [*self._keys, *self._rare_keys]
        packed = tensordict.exclude(*keys, *(_under_next(key) for key in keys))
        packed[STATE_KEY, "root"] = start + position
        packed[STATE_KEY, "step"] = (number - position).to(torch.int32)
        return packed

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the entries of the states into sampled transitions."""
        pointers = tensordict.pop(STATE_KEY)
        root = pointers["root"]
        rows = self._states.take(torch.stack([root, root + pointers["step"]]))
        parts = tensordict, tensordict.get("next")
        for field in self._fields:
            if field.key != _RARE_KEY:
                _write(parts, field, rows)
        if self._rare_fields:
            at = next(field for field in self._fields if field.key == _RARE_KEY)
            numbers = rows[..., at.start : at.stop].view(torch.int32).squeeze(-1)
            if self._rare.end == 0:
                rare = rows.new_zeros(*numbers.shape, _width(self._rare_fields))
            else:
                # Their numbers begin with 1; 0 stands for zeros.
                rare = self._rare.take((numbers - 1).clamp(min=0))
                rare = rare * (numbers > 0).unsqueeze(-1)
            for field in self._rare_fields:
                _write(parts, field, rare)
        return tensordict

    def get_extra_state(self) -> dict[str, Any]:
        return {key: self.__dict__[key] for key in _STATE}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        # Its rows are written in place.
        self.__dict__.update(deepcopy(state))

    def _packed(self, state: TensorDictBase) -> Tensor:
        """Return the entries of states as rows of bytes, those of the rare entries last."""
        if not self._fields:
            entries = {key: state.get(key) for key in self._keys}
            if self._rare_keys:
                entries[_RARE_KEY] = torch.empty(1, dtype=torch.int32)
            self._fields = _layout(entries)
            self._rare_fields = _layout({key: state.get(key) for key in self._rare_keys})
        like = state.get(self._keys[0])
        zero = torch.zeros(len(like), 1, dtype=torch.uint8, device=like.device)
        parts = []
        for fields in (self._fields, self._rare_fields):
            for key, dtype, *_ in fields:
                if key == _RARE_KEY:
                    parts.append(zero.expand(-1, RARE_BYTES))
                    continue
                value = state.get(key)
                if value.dtype != dtype:
                    raise ValueError(
                        f"key {key!r}: expected {dtype}, as in the transitions before, given "
                        f"{value.dtype}"
                    )
                flat = value.reshape(len(value), -1).contiguous()
                parts.append(flat.view(torch.uint8))
            parts.append(zero.expand(-1, _width(fields) - (fields[-1].stop if fields else 0)))
        return torch.cat(parts, -1)

    def _append(self, packed: Tensor, count: int) -> int:
        """Write the new states of a batch of transitions and return the first one's number."""
        rows, rare = packed.tensor_split([_width(self._fields)], -1)
        self._batches.append((count, self._batch_start, self._batch_rare_start))
        self._stored += count
        while self._stored - self._batches[0][0] >= self._max_size:
            self._stored -= self._batches.popleft()[0]
        _, oldest, oldest_rare = self._batches[0]
        self._batch_rare_start = self._rare.end
        if self._rare_fields:
            at = next(field for field in self._fields if field.key == _RARE_KEY)
            index = (rare != 0).any(-1).nonzero().squeeze(-1)
            if len(index):
                first = self._rare.append(rare[index], oldest_rare)
                numbers = torch.zeros(len(rows), 1, dtype=torch.int32, device=rows.device)
                numbers[index, 0] = (
                    1 + first + torch.arange(len(index), dtype=torch.int32, device=rows.device)
                )
                rows[:, at.start : at.stop] = numbers.view(torch.uint8)
        self._batch_start = self._states.append(rows, oldest)
        return self._batch_start


_STATE = (
    "_fields",
    "_rare_fields",
    "_states",
    "_rare",
    "_before",
    "_batches",
    "_stored",
    "_batch_start",
    "_batch_rare_start",
)


def _write(parts: tuple[TensorDictBase, TensorDictBase], field: _Field, rows: Tensor) -> None:
    """Write an entry of states and next states from their rows of bytes, ``(2, batch, bytes)``."""
    values = rows[..., field.start : field.stop].view(field.dtype)
    for part, value in zip(parts, values.unflatten(-1, field.shape or (1,)), strict=True):
        part.set(field.key, value if field.shape else value.squeeze(-1))


def _layout(entries: dict[NestedKey, Tensor]) -> list[_Field]:
    """Return where entries stand, those of the widest dtype first, so that all are aligned."""
    fields, stop = [], 0
    for key in sorted(entries, key=lambda key: -entries[key].dtype.itemsize):
        value = entries[key]
        start, shape = stop, value.shape[1:]
        stop += prod(shape) * value.dtype.itemsize
        fields.append(_Field(key, value.dtype, shape, start, stop))
    return fields


def _width(fields: Sequence[_Field]) -> int:
    """Return the bytes of a row, aligned to its widest dtype, which comes first."""
    if not fields:
        return 0
    stop, widest = fields[-1].stop, fields[0].dtype.itemsize
    return stop + -stop % widest


def _under_next(key: NestedKey) -> NestedKey:
    return ("next", *((key,) if isinstance(key, str) else key))
