"""Shapes of batches."""

from __future__ import annotations

import torch


def broadcast_shape(*shapes: torch.Size) -> torch.Size:
    """Return the shape that shapes broadcast to, at once where they are equal or empty."""
    known = [shape for shape in shapes if len(shape)]
    if all(shape == known[0] for shape in known):
        return known[0] if known else torch.Size()
    return torch.broadcast_shapes(*known)
