"""Running the examples as a user does, and spies that watch them."""

import importlib.util
import runpy
import sys
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from hydra.core.config_store import ConfigStore

EXAMPLES = Path(__file__).resolve().parents[2] / "experiments" / "examples"

Run = Callable[..., str]


@pytest.fixture(autouse=True)
def place(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Examples import each other; MuJoCo leaves a log where it runs."""
    monkeypatch.syspath_prepend(EXAMPLES)
    monkeypatch.chdir(tmp_path)


@pytest.fixture(autouse=True)
def store(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give a script a store of configurations of its own to register in, as a process has."""
    store = ConfigStore.instance()
    monkeypatch.setattr(store, "repo", deepcopy(store.repo))


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run an example with arguments and return what it prints."""

    def run(name: str, *arguments: object) -> str:
        script = str(EXAMPLES / f"{name}.py")
        monkeypatch.setattr(sys, "argv", [script, *map(str, arguments)])
        runpy.run_path(script, run_name="__main__")
        return capsys.readouterr().out

    return run


@pytest.fixture
def load() -> Callable[[str], ModuleType]:
    """Import an example, without running it."""

    def load(name: str) -> ModuleType:
        spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load


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
