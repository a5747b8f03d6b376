"""A folder of their own for the examples, and what records what they train."""

from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.core.config_store import ConfigStore

from tests.examples.scripts import EXAMPLES


@pytest.fixture(autouse=True)
def working_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Examples import each other; MuJoCo leaves a log where it runs."""
    monkeypatch.syspath_prepend(EXAMPLES)
    monkeypatch.chdir(tmp_path)


@pytest.fixture(autouse=True)
def store(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give a script a store of configurations of its own to register in, as a process has."""
    store = ConfigStore.instance()
    monkeypatch.setattr(store, "repo", deepcopy(store.repo))


class Optimized:
    """Every parameter that an Adam was given, with its first value."""

    def __init__(self) -> None:
        self.parameters: list[torch.nn.Parameter] = []
        self.first: list[torch.Tensor] = []

    def assert_all_learned(self) -> None:
        assert self.parameters
        for parameter, first in zip(self.parameters, self.first, strict=True):
            assert bool(parameter.isfinite().all())
            assert bool((parameter != first).any())


@pytest.fixture
def optimized(monkeypatch: pytest.MonkeyPatch) -> Optimized:
    """Watch what an example optimizes."""
    seen = Optimized()
    adam = torch.optim.Adam

    def spy(parameters: Any, **options: Any) -> torch.optim.Adam:
        parameters = list(parameters)
        seen.parameters += parameters
        seen.first += [parameter.detach().clone() for parameter in parameters]
        return adam(parameters, **options)

    monkeypatch.setattr(torch.optim, "Adam", spy)
    return seen
