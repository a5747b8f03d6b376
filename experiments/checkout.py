"""The commit that results are from."""

from __future__ import annotations

import subprocess
from pathlib import Path


def commit() -> str | None:
    """Return the checkout's commit, ending in ``-dirty`` if files differ, or None."""
    try:
        result = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return result.stdout.strip() or None
