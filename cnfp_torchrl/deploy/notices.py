"""Notices of PyTorch's exporters about themselves, which say nothing about the exported policy."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

_REGISTRATION = "torch.onnx._internal.exporter._registration"
_TORCHVISION = "torchvision is not installed"
_TREE_SPECIFICATION = r"`isinstance\(treespec, LeafSpec\)` is deprecated"


@contextmanager
def without_exporters_notices() -> Iterator[None]:
    """Leave out two notices of PyTorch 2.13 in this context; everything else is shown.

    They say that operators of torchvision are skipped, of which a policy has none, and that
    torch.export uses a class of its own that is deprecated.
    """
    logger = logging.getLogger(_REGISTRATION)
    logger.addFilter(_is_of_policy)
    try:
        with warnings.catch_warnings():
            # Python says that it comes from copyreg, which torch.export copies specifications with.
            warnings.filterwarnings("ignore", _TREE_SPECIFICATION, FutureWarning, "copyreg")
            yield
    finally:
        logger.removeFilter(_is_of_policy)


def _is_of_policy(record: logging.LogRecord) -> bool:
    return not record.getMessage().startswith(_TORCHVISION)
