"""From the folder of a finished run to its record: ``python -m experiments.paper.collect``."""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
import yaml

from cnfp_torchrl.training.run_folder import SUMMARY, RunFolder
from cnfp_torchrl.visual.figures import read_scalars
from experiments.paper.afterwards import evaluate_afterwards
from experiments.paper.records import Outcome, Record, Series

PRESENTATION = ("figures", "hydra", "logger", "visual")
"""Sections of the training configuration that change nothing in a result; not recorded."""

PACKAGES = ("cnfp_torchrl", "torch", "torchrl", "tensordict", "numpy")


def collect(folder: RunFolder) -> Record:
    """Return the record of a finished run, with what its policy does afterwards.

    Args:
        folder: of a run with ``experiment=METHOD`` and the CSV logger.

    Raises:
        ValueError: when the run was started without an experiment.
        FileNotFoundError: when the run is not finished.
    """
    text = (folder.path / ".hydra" / "overrides.yaml").read_text(encoding="utf-8")
    overrides = [str(each) for each in yaml.safe_load(text)]
    chosen = dict(each.split("=", 1) for each in overrides if "=" in each)
    if "experiment" not in chosen:
        raise ValueError(f"{folder.path}: expected a run with experiment=METHOD, given {overrides}")
    summary = json.loads((folder.path / SUMMARY).read_text())
    curves = read_scalars(folder.path / "metrics")
    own = ("experiment", "seed", *PRESENTATION)
    return Record(
        method=chosen["experiment"],
        seed=summary["seed"],
        overrides=tuple(each for each in overrides if each.split("=", 1)[0] not in own),
        config=settings(folder.load_settings()),
        versions=versions(),
        commit=commit(),
        steps=summary["steps"],
        seconds=summary["seconds"],
        curves={
            name: Series(
                tuple(int(step) for step in steps), tuple(_short(float(each)) for each in values)
            )
            for name, (steps, values) in curves.items()
        },
        training_violations=summary["training_violations"],
        evaluation={mode: Outcome(**outcome) for mode, outcome in summary["evaluation"].items()},
        afterwards=evaluate_afterwards(folder),
    )


def settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return what decides a run's result, as JSON would give it back.

    Args:
        config: plain data, with every interpolation resolved.
    """
    return json.loads(
        json.dumps({name: each for name, each in config.items() if name not in PRESENTATION})
    )


def versions() -> dict[str, str]:
    """Return the versions of what computes, and the kind of machine."""
    return {
        "python": platform.python_version(),
        **{name: version(name) for name in PACKAGES},
        "platform": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
    }


def commit() -> str | None:
    """Return the checkout's commit, ending in ``-dirty`` if files differ, or ``None``."""
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


def _short(value: float) -> float:
    """Return the value with as many digits as a figure shows; counts stay whole."""
    return value if value.is_integer() else float(f"{value:.6g}")


def main() -> None:
    """Write the record of a run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="folder of the finished run")
    parser.add_argument("data", type=Path, help="folder of the records")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    path = collect(RunFolder.open(arguments.run)).save(arguments.data)
    sys.stdout.write(f"{path}\n")


if __name__ == "__main__":
    main()
