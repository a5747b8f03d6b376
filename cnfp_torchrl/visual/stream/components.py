"""Single components of Rerun's archetypes from numbers, at half the archetypes' own cost."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

Logged = list[rr.DescribedComponentBatch]
"""What `rerun.RecordingStream.log` takes."""


class _Component:
    """One component of an archetype, in Arrow's format.

    Args:
        archetype: with this component alone.
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


def points(positions: NDArray[np.float32]) -> Logged:
    """Return the positions of points ``(n, 2)``."""
    return _POSITIONS.holding(_vectors(positions))


def strips(ends: NDArray[np.int32], positions: NDArray[np.float32]) -> Logged:
    """Return lines.

    Args:
        ends: where each line begins and the last one ends, ``(lines + 1,)``.
        positions: the points of all lines, ``(n, 2)``.
    """
    return _STRIPS.holding(
        pa.ListArray.from_arrays(pa.array(ends), _vectors(positions), type=_STRIPS.format)
    )


def arrows(origins: NDArray[np.float32], vectors: NDArray[np.float32]) -> Logged:
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


def text(words: str) -> Logged:
    """Return the content of a text; what language it is in, is logged once."""
    return _TEXT.holding(pa.array([words], _TEXT.format))


def _vectors(positions: NDArray[np.float32]) -> pa.Array:
    return pa.FixedSizeListArray.from_arrays(
        pa.array(positions.reshape(-1)), type=_POSITIONS.format
    )
