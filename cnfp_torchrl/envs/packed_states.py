"""The storage of states in a replay buffer, once a state instead of twice a transition."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from math import prod
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
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


class _Block(NamedTuple):
    """The entries of one dtype, which lie side by side in the bytes of a state."""

    dtype: torch.dtype
    shapes: dict[NestedKey, torch.Size]
    widths: list[int]
    """The numbers that each entry has."""
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
        # Whole rows, not element by element as indexing with several dimensions copies bytes.
        rows = self.rows.index_select(0, (numbers % len(self.rows)).flatten())
        return rows.unflatten(0, numbers.shape)

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
        self._blocks: list[_Block] = []
        self._rare_blocks: list[_Block] = []
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
        packed = tensordict.exclude(*keys, *(_under_next(key) for key in keys)).filter_empty_()
        packed[STATE_KEY, "root"] = start + position
        packed[STATE_KEY, "step"] = (number - position).to(torch.int32)
        return packed

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the entries of the states into sampled transitions."""
        pointers = tensordict.pop(STATE_KEY)
        root = pointers.get("root")
        rows = self._states.take(torch.stack([root, root + pointers.get("step")]))
        at_root: dict[str, Any] = {}
        after: dict[str, Any] = {}
        pointer = _write((at_root, after), self._blocks, rows)
        if pointer is not None:
            if self._rare.end == 0:
                rare = rows.new_zeros(*rows.shape[:-1], _width(self._rare_blocks))
            else:
                # Their numbers begin with 1; 0 stands for zeros.
                rare = self._rare.take((pointer - 1).clamp(min=0)) * (pointer > 0).unsqueeze(-1)
            _write((at_root, after), self._rare_blocks, rare)
        # Unchecked, because to set entry by entry takes ten times as long.
        entries = _merged(tensordict, {**at_root, "next": after})
        return TensorDict._new_unsafe(entries, tensordict.batch_size, tensordict.device)

    def get_extra_state(self) -> dict[str, Any]:
        return {key: self.__dict__[key] for key in _STATE}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        # Its rows are written in place.
        self.__dict__.update(deepcopy(state))

    def _packed(self, state: TensorDictBase) -> Tensor:
        """Return the entries of states as rows of bytes, those of the rare entries last."""
        if not self._blocks:
            entries = {key: state.get(key) for key in self._keys}
            if self._rare_keys:
                entries[_RARE_KEY] = torch.empty(1, dtype=torch.int32)
            self._blocks = _layout(entries)
            self._rare_blocks = _layout({key: state.get(key) for key in self._rare_keys})
        like = state.get(self._keys[0])
        zero = torch.zeros(len(like), 1, dtype=torch.uint8, device=like.device)
        parts = []
        for blocks in (self._blocks, self._rare_blocks):
            for block in blocks:
                for key in block.shapes:
                    if key == _RARE_KEY:
                        parts.append(zero.expand(-1, RARE_BYTES))
                        continue
                    value = state.get(key)
                    if value.dtype != block.dtype:
                        raise ValueError(
                            f"key {key!r}: expected {block.dtype}, as in the transitions before, "
                            f"given {value.dtype}"
                        )
                    flat = value.reshape(len(value), -1).contiguous()
                    parts.append(flat.view(torch.uint8))
            parts.append(zero.expand(-1, _width(blocks) - (blocks[-1].stop if blocks else 0)))
        return torch.cat(parts, -1)

    def _append(self, packed: Tensor, count: int) -> int:
        """Write the new states of a batch of transitions and return the first one's number."""
        rows, rare = packed.tensor_split([_width(self._blocks)], -1)
        self._batches.append((count, self._batch_start, self._batch_rare_start))
        self._stored += count
        while self._stored - self._batches[0][0] >= self._max_size:
            self._stored -= self._batches.popleft()[0]
        _, oldest, oldest_rare = self._batches[0]
        self._batch_rare_start = self._rare.end
        if self._rare_blocks:
            index = (rare != 0).any(-1).nonzero().squeeze(-1)
            if len(index):
                first = self._rare.append(rare[index], oldest_rare)
                numbers = torch.zeros(len(rows), 1, dtype=torch.int32, device=rows.device)
                numbers[index, 0] = (
                    1 + first + torch.arange(len(index), dtype=torch.int32, device=rows.device)
                )
                rows[:, _bytes_of(_RARE_KEY, self._blocks)] = numbers.view(torch.uint8)
        self._batch_start = self._states.append(rows, oldest)
        return self._batch_start


_STATE = (
    "_blocks",
    "_rare_blocks",
    "_states",
    "_rare",
    "_before",
    "_batches",
    "_stored",
    "_batch_start",
    "_batch_rare_start",
)


def _write(
    trees: Iterable[dict[str, Any]], blocks: Iterable[_Block], rows: Tensor
) -> Tensor | None:
    """Write the entries of states from their rows of bytes, a batch of rows for each nested dict.

    Returns the pointers to rows of rare entries instead of writing them.
    """
    pointers = []
    for tree, row in zip(trees, rows, strict=True):
        for dtype, shapes, widths, start, stop in blocks:
            values = row[..., start:stop].view(dtype).split_with_sizes(widths, -1)
            for (key, shape), value in zip(shapes.items(), values, strict=True):
                if len(shape) != 1:
                    value = value.unflatten(-1, shape) if shape else value.squeeze(-1)
                if key == _RARE_KEY:
                    pointers.append(value)
                    continue
                *path, name = (key,) if isinstance(key, str) else key
                branch = tree
                for step in path:
                    branch = branch.setdefault(step, {})
                branch[name] = value
    return torch.stack(pointers) if pointers else None


def _merged(known: TensorDictBase, tree: dict[str, Any]) -> dict[str, Any]:
    """Return the entries of a tensordict and of a nested dict, which wins, as a nested dict."""
    entries = dict(known.items())
    for name, branch in tree.items():
        inner = entries.get(name)
        is_inner = isinstance(branch, dict) and inner is not None
        entries[name] = _merged(inner, branch) if is_inner else branch
    return entries


def _layout(entries: Mapping[NestedKey, Tensor]) -> list[_Block]:
    """Return where entries stand, those of the widest dtype first, so that all are aligned."""
    by_dtype: dict[torch.dtype, dict[NestedKey, torch.Size]] = {}
    for key, value in entries.items():
        by_dtype.setdefault(value.dtype, {})[key] = value.shape[1:]
    blocks, stop = [], 0
    for dtype in sorted(by_dtype, key=lambda dtype: -dtype.itemsize):
        shapes = by_dtype[dtype]
        widths = [prod(shape) for shape in shapes.values()]
        start, stop = stop, stop + sum(widths) * dtype.itemsize
        blocks.append(_Block(dtype, shapes, widths, start, stop))
    return blocks


def _bytes_of(wanted: NestedKey, blocks: Iterable[_Block]) -> slice:
    """Return where an entry stands in the rows."""
    for dtype, shapes, widths, start, _ in blocks:
        if wanted in shapes:
            at = list(shapes).index(wanted)
            first = start + sum(widths[:at]) * dtype.itemsize
            return slice(first, first + widths[at] * dtype.itemsize)
    raise KeyError(wanted)


def _width(blocks: Sequence[_Block]) -> int:
    """Return the bytes of a row, aligned to its widest dtype, which comes first."""
    if not blocks:
        return 0
    stop, widest = blocks[-1].stop, blocks[0].dtype.itemsize
    return stop + -stop % widest


def _under_next(key: NestedKey) -> NestedKey:
    return ("next", *((key,) if isinstance(key, str) else key))
