"""Every configuration file is composed, and every group's option runs for a few steps."""

from pathlib import Path

import pytest
from hydra.errors import MissingConfigException

from cnfp_torchrl.configuration import compose_config, config_directory
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.train import train

TINY = [
    "collector.total_frames=32",
    "training.warmup_frames=16",
    "training.update_ratio=0.1",
    "evaluation.episodes=2",
    "+env.base.max_steps=5",
    "collector.frames_per_batch=16",
]


# What belongs to another algorithm than the default runs as a part of it.
PARTS = {("loss", "ppo"), ("loss", "td3"), ("network", "deterministic"), ("network", "state_value")}
OPTIONS = sorted(
    str(path.relative_to(config_directory()).with_suffix(""))
    for path in config_directory().glob("*/**/*.yaml")
    # Those that need a viewer, a port or a display have tests of their own.
    if path.parent.name != "visual" or path.stem in ("off", "file")
    # Those that start processes, too.
    if path.parent.name != "collector" or path.stem == "single"
    # Those of another algorithm than the default are parts of its option.
    if path.stem not in ("ppo", "td3", "deterministic", "state_value")
    or path.parent.name == "algorithm"
)


@pytest.mark.parametrize("option", OPTIONS)
def test_every_option_runs(option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    group, _, name = option.rpartition("/")
    config = compose_config("figures=none", f"{group}={name}", *TINY)
    summary = train(config, RunFolder.create(tmp_path / "run"))
    assert summary["steps"] == 32


@pytest.mark.parametrize("name", ["train", "evaluate", "audit"])
def test_every_main_configuration_composes(name: str) -> None:
    assert compose_config(name=name)


@pytest.mark.parametrize("loss", ["sac", "sac_lagrangian"])
def test_the_target_entropy_is_the_task_s_or_that_of_the_action_bounds(loss: str) -> None:
    assert compose_config(f"loss={loss}", "env.target_entropy=-3.0").loss.target_entropy == -3
    assert compose_config(f"loss={loss}", "~env.target_entropy").loss.target_entropy == "auto"


def test_an_unknown_experiment_is_refused_with_the_choices() -> None:
    with pytest.raises(MissingConfigException, match=r"(?s)lagrangain.*lagrangian"):
        compose_config("experiment=lagrangain")


def test_an_experiment_overrides_the_main_file_and_the_command_line_overrides_it(
    tmp_path: Path,
) -> None:
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "mine.yaml").write_text(
        "# @package _global_\nseed: 7\ntraining:\n  log_interval: 70\n"
    )
    own = ["experiment=mine", f"hydra.searchpath=[file://{tmp_path}]"]
    config = compose_config(*own, "training.log_interval=80")
    assert (config.seed, config.training.log_interval) == (7, 80)
