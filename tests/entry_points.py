"""The commands that the checkout's pyproject.toml declares, whatever is installed."""

import tomllib
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]


def load_command(name: str) -> Callable[[], Any]:
    """Return what a command runs."""
    module, _, function = SCRIPTS[name].partition(":")
    return getattr(import_module(module), function)
