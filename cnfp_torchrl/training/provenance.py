"""Where a run came from: versions, commit, command and machine, for its summary."""

from __future__ import annotations

import os
import platform
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch

from cnfp_torchrl.installed_versions import installed_versions

_PACKAGES = ("cnfp_torchrl", "torch", "torchrl", "tensordict", "numpy", "gymnasium", "mujoco")


_COMMAND = "CNFP_TORCHRL_COMMAND"


def remember_command(name: str) -> None:
    """Remember the command as it was given, before Hydra's quotes, and for all its processes."""
    os.environ[_COMMAND] = shlex.join([name, *sys.argv[1:]])


def provenance(device: str) -> dict[str, Any]:
    """Return versions, the commit of the source if there is one, the command and the machine.

    Args:
        device: The device of training.
    """
    machine: dict[str, Any] = {
        "system": f"{platform.system()} {platform.machine()}",
        "cores": os.cpu_count(),
        "device": device,
    }
    if device.startswith("cuda"):
        machine["accelerator"] = torch.cuda.get_device_name(device)
    return {
        "versions": {"python": platform.python_version(), **installed_versions(_PACKAGES)},
        "commit": _commit(Path(__file__).parent),
        "command": os.environ.get(_COMMAND) or shlex.join(["python", *sys.orig_argv[1:]]),
        "machine": machine,
    }


def _commit(folder: Path) -> str | None:
    """Return the commit of this package's source, marked where files differ from it."""
    # An installed package may lie in a repository of somebody else, which says nothing of it.
    tracked = _git(folder, "ls-files", "--error-unmatch", Path(__file__).name)
    commit = _git(folder, "rev-parse", "HEAD") if tracked else None
    if not commit:
        return None
    return (
        f"{commit}, changed"
        if _git(folder, "status", "--porcelain", "--untracked-files=no")
        else commit
    )


def _git(folder: Path, *arguments: str) -> str | None:
    """Return what git says in a folder; None where there is no git, or no repository."""
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *arguments],
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
