"""What all tests share: one thread per worker, and the same random numbers for each test."""

import logging
import os
import random
from collections.abc import Iterator

# Read when NumPy is first imported; each worker has one core to itself.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pytest
import torch

from tests.torchrl_store import registered


def pytest_configure() -> None:
    # Whatever imports TorchRL's groups later finds them imported, and Hydra's store as it was.
    registered()
    # pytest-xdist starts one worker per core; more threads than that only wait for each other.
    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def logging_as_before() -> Iterator[None]:
    """Close handlers that a test left behind, as Hydra does: they write to its output alone."""
    root = logging.getLogger()
    before = list(root.handlers)
    yield
    for handler in set(root.handlers) - set(before):
        root.removeHandler(handler)
        handler.close()


@pytest.fixture(autouse=True)
def seed() -> int:
    """Seed every global generator, so that a test does not depend on those that ran before it."""
    value = 0
    random.seed(value)
    np.random.seed(value)  # noqa: NPY002  (libraries draw from the global generator)
    torch.manual_seed(value)
    return value
