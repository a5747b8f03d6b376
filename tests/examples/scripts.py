"""Running the examples as a user does."""

import importlib.util
import io
import runpy
import sys
from contextlib import redirect_stdout, suppress
from pathlib import Path
from types import ModuleType
from unittest.mock import patch

EXAMPLES = Path(__file__).resolve().parents[2] / "experiments" / "examples"


def run(name: str, *arguments: object) -> str:
    """Run an example with arguments and return what it prints."""
    script = str(EXAMPLES / f"{name}.py")
    with (
        patch.object(sys, "argv", [script, *map(str, arguments)]),
        redirect_stdout(io.StringIO()) as printed,
        suppress(SystemExit),  # with which --help ends
    ):
        runpy.run_path(script, run_name="__main__")
    return printed.getvalue()


def load(name: str) -> ModuleType:
    """Import an example, without running it."""
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
