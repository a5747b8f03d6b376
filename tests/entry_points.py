"""The commands that the checkout's pyproject.toml declares, whatever is installed."""

import os
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path
from unittest.mock import patch

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]


def call_command(name: str, *arguments: str) -> int:
    """Call a command in this process, and return its exit status."""
    module, _, function = SCRIPTS[name].partition(":")
    with patch.object(sys, "argv", [name, *arguments]):
        try:
            getattr(import_module(module), function)()
        except SystemExit as ended:
            return int(ended.code or 0)
    return 0


def run_command(folder: Path, name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a command in a process of its own, in a folder."""
    module, _, function = SCRIPTS[name].partition(":")
    return subprocess.run(
        [sys.executable, "-c", f"from {module} import {function}; {function}()", *arguments],
        cwd=folder,
        env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
