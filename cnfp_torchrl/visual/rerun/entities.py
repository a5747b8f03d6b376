"""Entities of Rerun: styles once, positions when they change, at half the archetypes' own cost."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import ArrayLike, NDArray

_END: NDArray[np.int32] = np.zeros(1, dtype=np.int32)
_NOTHING: NDArray[np.float32] = np.zeros((0, 2), dtype=np.float32)

Logged = list[rr.DescribedComponentBatch]
"""What `rerun.RecordingStream.log` takes."""


class _Component:
    """One component of an archetype, in Arrow's format.

    Args:
        archetype: The archetype, with this component alone.
    """

    def __init__(self, archetype: rr.AsComponents) -> None:
        (batch,) = archetype.as_component_batches()
        self._descriptor = batch.component_descriptor()
        self.format: pa.DataType = batch.as_arrow_array().type

    def holding(self, values: pa.Array) -> Logged:
        """Return the component with values of its format."""
        return [rr.DescribedComponentBatch(_Values(values), self._descriptor)]


class _Values:
    """What Rerun asks for an Arrow array."""

    def __init__(self, values: pa.Array) -> None:
        self._values = values

    def as_arrow_array(self) -> pa.Array:
        return self._values


_POSITIONS = _Component(rr.Points2D.from_fields(positions=[]))
_STRIPS = _Component(rr.LineStrips2D.from_fields(strips=[]))
_ORIGINS = _Component(rr.Arrows2D.from_fields(origins=[]))
_VECTORS = _Component(rr.Arrows2D.from_fields(vectors=[]))
_BUFFER = _Component(rr.DepthImage.from_fields(buffer=b""))
_SCALARS = _Component(rr.Scalars.from_fields(scalars=[]))
_TEXT = _Component(rr.TextDocument.from_fields(text=""))


def points_of(positions: NDArray[np.float32]) -> Logged:
    """Return the positions of points ``(n, 2)``."""
    return _POSITIONS.holding(_vectors(positions))


def strips_of(ends: NDArray[np.int32], positions: NDArray[np.float32]) -> Logged:
    """Return lines.

    Args:
        ends: The numbers where each line begins and the last one ends, ``(lines + 1,)``.
        positions: The points of all lines, ``(n, 2)``.
    """
    return _STRIPS.holding(
        pa.ListArray.from_arrays(pa.array(ends), _vectors(positions), type=_STRIPS.format)
    )


def arrows_of(origins: NDArray[np.float32], vectors: NDArray[np.float32]) -> Logged:
    """Return arrows, each ``(n, 2)``."""
    return [*_ORIGINS.holding(_vectors(origins)), *_VECTORS.holding(_vectors(vectors))]


def pixels(image: NDArray[np.uint8]) -> Logged:
    """Return the content of an image of one channel, ``(height, width)``."""
    ends = pa.array([0, image.size], pa.int32())
    return _BUFFER.holding(
        pa.ListArray.from_arrays(ends, pa.array(image.reshape(-1)), type=_BUFFER.format)
    )


def scalars(values: Sequence[float]) -> Logged:
    """Return numbers of a time series."""
    return _SCALARS.holding(pa.array(values, _SCALARS.format))


def text(content: str) -> Logged:
    """Return the content of a text; what language it is in, is logged once."""
    return _TEXT.holding(pa.array([content], _TEXT.format))


def _vectors(positions: NDArray[np.float32]) -> pa.Array:
    return pa.FixedSizeListArray.from_arrays(
        pa.array(positions.reshape(-1)), type=_POSITIONS.format
    )


class Entities:
    """Log what lies below one entity path, and leave out what is as it was.

    Rerun shows the latest value at a time, so that an entity logged once stands until it changes.

    Args:
        stream: The stream to log to.
        root: The path.
    """

    def __init__(self, stream: rr.RecordingStream, root: str) -> None:
        self._stream, self._root = stream, root
        self._last: dict[str, tuple[bytes, bytes]] = {}

    def style(self, name: str, *archetypes: rr.AsComponents) -> None:
        """Log what never changes; such as has no positions, which would hide those of the steps.

        Args:
            name: The name of the entity, or nothing for the root itself.
            archetypes: The archetypes of the entity.
        """
        self._stream.log(f"{self._root}/{name}".rstrip("/"), *archetypes, static=True)

    def points(self, name: str, positions: ArrayLike) -> None:
        """Log points ``(n, 2)``."""
        given = np.asarray(positions, dtype=np.float32).reshape(-1, 2)
        if self._is_new(name, _END, given):
            self.log(name, points_of(given))

    def lines(self, name: str, strips: Sequence[ArrayLike] | NDArray[np.float32]) -> None:
        """Log lines, each ``(points, 2)``."""
        ends, flat = _joined(strips)
        if self._is_new(name, ends, flat):
            self.log(name, strips_of(ends, flat))

    def path(self, name: str, positions: ArrayLike) -> None:
        """Log a path ``(n, 2)``: a line where there is one, and its points, the last one twice.

        That is a disc, and a dark one below it for its rim.
        """
        given = np.asarray(positions, dtype=np.float32)
        if self._is_new(name, _END, given):
            values = points_of(np.concatenate([given, given[-1:]]))
            if len(given) > 1:
                ends = np.array([0, len(given)], dtype=np.int32)
                values += strips_of(ends, given)
            self.log(name, values)

    def arrow(self, name: str, origin: ArrayLike, vector: ArrayLike) -> None:
        """Log an arrow, origin and vector ``(2,)``."""
        ends = (np.asarray(end, dtype=np.float32) for end in (origin, vector))
        self.log(name, arrows_of(*ends))

    def log(self, name: str, values: Logged) -> None:
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
