"""The ways in which modules, environments and losses are copied."""

import copy
import pickle
from typing import Any

import pytest


def pickled(given: Any) -> Any:
    return pickle.loads(pickle.dumps(given))


EVERY_COPY = pytest.mark.parametrize("copied", [copy.deepcopy, pickled])
