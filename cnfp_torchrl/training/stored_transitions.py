"""The replay buffer on disk: every transition is written once, however often checkpoints are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tensordict import TensorDict, TensorDictBase
from torchrl.data import ReplayBuffer

from cnfp_torchrl.training.checkpoints import CheckpointError, load_data, save_data

_PART, _SUFFIX = "transitions-", ".pt"


class StoredTransitions:
    """Extends a replay buffer, and writes what it was extended with since the last time.

    The buffer is filled again by the same transitions in the same batches, which serves every
    storage, writer and transform. What a sampler has drawn is its own state.

    Args:
        buffer: The buffer, empty, which overwrites its oldest transitions first.
        path: The folder of the files.
        is_saved: Whether files are written at all; otherwise nothing is remembered for them.
    """

    def __init__(self, buffer: ReplayBuffer, path: Path, *, is_saved: bool = True) -> None:
        self._buffer, self._path = buffer, path
        self._is_saved = is_saved
        self._count = 0
        self._pending: list[TensorDictBase] = []

    def extend(self, batch: TensorDictBase) -> None:
        """Extend the buffer by a batch of transitions ``(steps,)``."""
        self._buffer.extend(batch)
        if self._is_saved:
            self._pending.append(batch)
        self._count += len(batch)

    def save(self) -> None:
        """Write the transitions since the last time into a file of their own.

        Raises:
            CheckpointError: when the file cannot be written.
        """
        if self._pending:
            joined: TensorDictBase = TensorDict.cat(self._pending)
            content = {
                "lengths": [len(batch) for batch in self._pending],
                "device": str(joined.get("action").device),
                "transitions": joined.cpu().to_dict(),
            }
            save_data(self._file(self._count), content, self._path.parent)
            self._pending.clear()

    def forget(self, oldest: int) -> None:
        """Remove the files that no state needs any more.

        Args:
            oldest: The number of transitions at the oldest state that is kept.
        """
        overwritten = oldest - self._buffer.storage.max_size
        for end in self._ends():
            if end <= overwritten:
                self._file(end).unlink()

    def state_dict(self) -> dict[str, Any]:
        """Return the number of transitions and the sampler's state."""
        return {"count": self._count, "sampler": dict(self._buffer.sampler.state_dict())}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Fill the buffer with the transitions up to a state, and remove those after it."""
        count = state["count"]
        for end in self._ends():
            if end > count:
                self._file(end).unlink()
        parts, start = self._parts(count)
        writer = self._buffer.writer
        position = {"_cursor": start % self._buffer.storage.max_size, "_write_count": start}
        writer.load_state_dict({**writer.state_dict(), **position})
        for content in parts:
            lengths = content["lengths"]
            joined = TensorDict.from_dict(content["transitions"], batch_size=[sum(lengths)])
            for batch in joined.to(content["device"]).split(lengths):
                self._buffer.extend(batch)
        self._buffer.sampler.load_state_dict(state["sampler"])
        self._count = count

    def _parts(self, count: int) -> tuple[list[dict[str, Any]], int]:
        """Return the contents of the files, oldest first, and the number of transitions before."""
        parts: list[dict[str, Any]] = []
        start = count
        wanted = max(count - self._buffer.storage.max_size, 0)
        while start > wanted:
            path = self._file(start)
            if not path.is_file():
                raise CheckpointError(f"{path}: expected a file that training wrote, given none")
            parts.append(load_data(path))
            start -= sum(parts[-1]["lengths"])
        return parts[::-1], start

    def _ends(self) -> list[int]:
        files = self._path.glob(f"{_PART}*{_SUFFIX}")
        numbers = (path.stem.removeprefix(_PART) for path in files)
        return sorted(int(number) for number in numbers if number.isdigit())

    def _file(self, end: int) -> Path:
        return self._path / f"{_PART}{end:012d}{_SUFFIX}"
