"""The entities of one view: styles once, positions when they change."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
from numpy.typing import ArrayLike, NDArray

from cnfp_torchrl.visual.stream import components

_END: NDArray[np.int32] = np.zeros(1, dtype=np.int32)
_NOTHING: NDArray[np.float32] = np.zeros((0, 2), dtype=np.float32)


class Entities:
    """Log what lies below one entity path, and leave out what is as it was.

    Rerun shows the latest value at a time, so that an entity logged once stands until it changes.

    Args:
        stream: where to log.
        root: the path.
    """

    def __init__(self, stream: rr.RecordingStream, root: str) -> None:
        self._stream, self._root = stream, root
        self._last: dict[str, tuple[bytes, bytes]] = {}

    def style(self, name: str, *archetypes: rr.AsComponents) -> None:
        """Log what never changes; such as has no positions, which would hide those of the steps.

        Args:
            name: of the entity, or nothing for the root itself.
            archetypes: of the entity.
        """
        self._stream.log(f"{self._root}/{name}".rstrip("/"), *archetypes, static=True)

    def points(self, name: str, positions: ArrayLike) -> None:
        """Log points ``(n, 2)``."""
        given = np.asarray(positions, dtype=np.float32).reshape(-1, 2)
        if self._is_new(name, _END, given):
            self.log(name, components.points(given))

    def lines(self, name: str, strips: Sequence[ArrayLike] | NDArray[np.float32]) -> None:
        """Log lines, each ``(points, 2)``."""
        ends, flat = _joined(strips)
        if self._is_new(name, ends, flat):
            self.log(name, components.strips(ends, flat))

    def path(self, name: str, positions: ArrayLike) -> None:
        """Log a path ``(n, 2)``: a line where there is one, and its points, the last one twice.

        That is a disc, and a dark one below it for its rim.
        """
        given = np.asarray(positions, dtype=np.float32)
        if self._is_new(name, _END, given):
            values = components.points(np.concatenate([given, given[-1:]]))
            if len(given) > 1:
                ends = np.array([0, len(given)], dtype=np.int32)
                values += components.strips(ends, given)
            self.log(name, values)

    def arrow(self, name: str, origin: ArrayLike, vector: ArrayLike) -> None:
        """Log an arrow, origin and vector ``(2,)``."""
        ends = (np.asarray(end, dtype=np.float32) for end in (origin, vector))
        self.log(name, components.arrows(*ends))

    def log(self, name: str, values: components.Logged) -> None:
        """Log anything else."""
        self._stream.log(f"{self._root}/{name}", values)

    def _is_new(self, name: str, ends: NDArray[np.int32], flat: NDArray[np.float32]) -> bool:
        # What is empty at first is logged, too: another stream may have left something there.
        last = self._last.get(name)
        now = self._last[name] = ends.tobytes(), flat.tobytes()
        return now != last


def _joined(
    strips: Sequence[ArrayLike] | NDArray[np.float32],
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return where each line begins and the last one ends, and the points of all lines."""
    if isinstance(strips, np.ndarray):
        lines, points, _ = strips.shape
        ends = np.arange(0, lines * points + 1, points, dtype=np.int32)
        return ends, np.ascontiguousarray(strips, dtype=np.float32).reshape(-1, 2)
    if not strips:
        return _END, _NOTHING
    given = [np.asarray(strip, dtype=np.float32) for strip in strips]
    ends = np.cumsum([0, *map(len, given)], dtype=np.int32)
    return ends, np.concatenate(given)
