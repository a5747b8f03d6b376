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
from hydra.core.config_store import ConfigStore


def pytest_configure() -> None:
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
def store_of_our_configurations() -> Iterator[None]:
    """Hold Hydra's store free of TorchRL's groups, which other tests' commands would be held to.

    A test that needs them takes ``registered`` of ``tests/configuration/test_torchrl_groups.py``.
    """
    yield
    assert "trainer" not in ConfigStore.instance().repo


@pytest.fixture(autouse=True)
def seed() -> int:
    """Seed every global generator, so that a test does not depend on those that ran before it."""
    value = 0
    random.seed(value)
    np.random.seed(value)  # noqa: NPY002  (libraries draw from the global generator)
    torch.manual_seed(value)
    return value


@pytest.fixture
def fresh_compiler() -> Iterator[None]:
    """Forget compiled graphs, of which PyTorch keeps a limited number for each code object."""
    torch.compiler.reset()
    yield
    torch.compiler.reset()
