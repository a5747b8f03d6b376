"""Tiny runs of the real trainer."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from cnfp_torchrl.configuration import config_directory
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.train import train

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
def make_config() -> Callable[..., DictConfig]:
    def make(*overrides: str, name: str = "train") -> DictConfig:
        with initialize_config_dir(str(config_directory()), version_base="1.3"):
            return compose(name, overrides=list(overrides))

    return make


@pytest.fixture
def tiny_run(
    make_config: Callable[..., DictConfig], tmp_path: Path
) -> Callable[..., tuple[RunFolder, dict[str, Any]]]:
    """Train for a few steps; returns the run's folder and its summary."""

    def run(*overrides: str) -> tuple[RunFolder, dict[str, Any]]:
        folder = RunFolder.create(tmp_path / f"run{len(list(tmp_path.iterdir()))}")
        return folder, train(make_config(*TINY, *overrides), folder)

    return run
