"""How often the host waits for the GPU."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import torch


def waits(call: Callable[[], object]) -> int:
    """Return how often a call waits for the GPU."""
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            call()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return sum("synchroniz" in str(warning.message) for warning in caught)
