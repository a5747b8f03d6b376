"""Reads of tensors on the host, for which a program on a GPU waits; counted on any machine."""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Self
from unittest.mock import patch

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

_WAITS = (
    "aten::_local_scalar_dense",
    "aten::equal",
    "aten::is_nonzero",
    "aten::lift_fresh",
    "aten::masked_select",
    "aten::nonzero",
)
"""Operations whose result the host waits for, or that copy numbers of Python's to the device."""


@contextmanager
def no_synchronization() -> Iterator[None]:
    """Let whatever waits for a GPU raise an error in this context."""
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


class HostReads(TorchDispatchMode):
    """Counts, by the line of this project's code, operations that would wait for a GPU."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: Counter[str] = Counter()

    @property
    def count(self) -> int:
        """The number of reads."""
        return self.lines.total()

    def __enter__(self) -> Self:
        # It reads without an operation that is dispatched.
        tolist = Tensor.tolist

        def counted(tensor: Tensor) -> Any:
            self._count("tolist")
            return tolist(tensor)

        self._patch = patch.object(Tensor, "tolist", counted)
        self._patch.start()
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        self._patch.stop()
        super().__exit__(*error)

    def _count(self, name: str) -> None:
        frames = [f for f in traceback.extract_stack() if "cnfp_torchrl" in f.filename]
        at = f"{frames[-1].filename}:{frames[-1].lineno}" if frames else "elsewhere"
        self.lines[f"{at} {name}"] += 1

    def __torch_dispatch__(
        self,
        func: Any,
        types: Sequence[type],
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        name = func._schema.name
        masked = name.startswith("aten::index") and any(
            isinstance(argument, Tensor) and argument.dtype == torch.bool
            for argument in (args[1] if len(args) > 1 and isinstance(args[1], list | tuple) else ())
        )
        if name in _WAITS or masked:
            self._count(name)
        return func(*args, **(kwargs or {}))
