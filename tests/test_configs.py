"""Every configuration file is composed, and every group's option runs for a few steps."""

from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from cnfp_torchrl.configuration import config_directory
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.train import train

TINY = [
    "collector.total_frames=64",
    "training.warmup_frames=32",
    "training.update_ratio=0.05",
    "evaluation.episodes=2",
    "+env.base.max_steps=5",
]
OPTIONS = sorted(
    str(path.relative_to(config_directory()).with_suffix(""))
    for path in config_directory().glob("*/**/*.yaml")
    # Those that need a viewer, a port or a display have tests of their own.
    if path.parent.name != "visual" or path.stem in ("off", "file")
)


@pytest.mark.parametrize("option", OPTIONS)
def test_every_option_runs(option: str, tmp_path: Path) -> None:
    group, _, name = option.rpartition("/")
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        config = compose("train", overrides=["figures=none", f"{group}={name}", *TINY])
    summary = train(config, RunFolder.create(tmp_path / "run"))
    assert summary["steps"] == 64


@pytest.mark.parametrize("name", ["train", "evaluate", "audit"])
def test_every_main_configuration_composes(name: str) -> None:
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        assert compose(name)
