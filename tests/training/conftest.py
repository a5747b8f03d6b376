"""Tiny runs of the real trainer."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.train import train

TinyRun = Callable[..., tuple[RunFolder, dict[str, Any]]]

TINY = [
    "collector.total_frames=192",
    "training.warmup_frames=96",
    "training.update_ratio=0.05",
    "training.log_interval=64",
    "evaluation.episodes=4",
    "+env.base.max_steps=12",
    "figures=none",
]


@pytest.fixture
def tiny_run(tmp_path: Path) -> TinyRun:
    """Train for a few steps; returns the run's folder and its summary."""

    def run(*overrides: str) -> tuple[RunFolder, dict[str, Any]]:
        folder = RunFolder.create(tmp_path / f"run{len(list(tmp_path.iterdir()))}")
        return folder, train(compose_config(*TINY, *overrides), folder)

    return run
