"""Settings that make no sense are refused before anything runs, with words that help."""

from collections.abc import Callable
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from cnfp_torchrl.configuration import compose_config, require_settings
from cnfp_torchrl.tasks.point_nav import PointNavEnv
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.train import train

COUNT, WHOLE = "a whole number >= 1", "a whole number >= 0"
REFUSED = {
    "seed": (WHOLE, ["-3", "abc", "null", "1.5", "true"]),
    "threads": (COUNT, ["0", "abc", "null"]),
    "env.agents": (COUNT, ["0", "abc", "true"]),
    "env.order": ("a list of the constraints' names", ["battery", "[0,1]", "null"]),
    "env.score.zero": ("a finite number", ["abc", "null", "nan", "inf"]),
    "env.score.one": ("another return than env.score.zero", ["-104.0"]),
    "network.hidden": ("a list of whole numbers >= 1", ["64", "[0]", "[64,wide]"]),
    "loss.gamma": ("a discount in [0, 1)", ["1.5", "abc", "nan"]),
    "loss.loss_function": ("'l2', 'smooth_l1' or 'l1'", ["abc", "null", "2"]),
    "loss.target_entropy": ("a finite number or 'auto'", ["abc", "null", "inf"]),
    "target.tau": ("a number in (0, 1]", ["0", "1.5", "abc", "nan"]),
    "optim.lr": ("a finite number > 0", ["0", "-1", "abc", "null", "nan", "inf"]),
    "collector.total_frames": (COUNT, ["-3", "0", "abc", "null", "1.5", "1.5e0"]),
    "collector.frames_per_batch": (COUNT, ["-3", "0", "abc", "null", "1.5"]),
    "replay_buffer.batch_size": (COUNT, ["-3", "0", "abc", "null", "1.5"]),
    "replay_buffer.storage.max_size": (COUNT, ["-3", "0", "abc", "null", "1.5"]),
    "training.warmup_frames": (WHOLE, ["-1", "1.5", "abc", "true"]),
    "training.update_ratio": ("a finite number >= 0", ["-1", "abc", "nan", "inf"]),
    "training.log_interval": (COUNT, ["0", "1.5", "null"]),
    "evaluation.episodes": (COUNT, ["0", "1.5", "abc"]),
    "evaluation.seed": (WHOLE, ["-1", "1.5", "abc", "null"]),
}
REFUSED_OF_OPTIONS = {
    "experiment=penalty env.penalty.penalty": ("a finite number > 0", "abc"),
    "experiment=squash_radius_4 flow.max_radius": ("a number > 0", "abc"),
    "experiment=lagrangian loss.gamma_cost": ("a discount", "abc"),
    "experiment=lagrangian loss.thresholds": ("a finite number >= 0, or a list", "[0,-1]"),
    "experiment=lagrangian loss.lambda_init": ("a finite number > 0", "abc"),
    "experiment=lagrangian loss.lambda_max": ("a finite number > 0", "abc"),
    "experiment=lagrangian loss.num_cost_nets": (COUNT, "1.5"),
    "visual=file visual.every": (COUNT, "1.5"),
    "visual=file visual.episodes": (COUNT, "abc"),
    "visual=file visual.samples": (COUNT, "1.5"),
    "visual=file visual.deterministic": ("true or false", "maybe"),
    "visual=file visual.projections": ("a list of pairs such as [[0, 1]], or null", "3"),
    "visual=serve visual.viewer.web_port": ("a port from 1 to 65535", "70000"),
    "visual=spawn visual.viewer.port": ("a port from 1 to 65535, or null", "abc"),
}
CASES = [
    *((name, expected, value) for name, (expected, bad) in REFUSED.items() for value in bad),
    *((name, expected, value) for name, (expected, value) in REFUSED_OF_OPTIONS.items()),
]


@cache
def composed(*options: str) -> DictConfig:
    """Return a configuration, which takes longer to compose than a setting to be refused."""
    return compose_config(*options)


@pytest.fixture
def refusal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Return what training says of overrides, before any step and any file."""

    def no_step(*_: Any) -> None:
        raise AssertionError("the environment was stepped")

    monkeypatch.setattr(PointNavEnv, "_step", no_step)

    def refuse(*settings: str, options: tuple[str, ...] = ()) -> str:
        folder = RunFolder.create(tmp_path / "run")
        config = deepcopy(composed(*options))
        for override in OverridesParser.create().parse_overrides(list(settings)):
            OmegaConf.update(config, override.key_or_group, override.value())
        with pytest.raises(Exception, match="expected") as refused:
            train(config, folder)
        assert not list(folder.path.iterdir())
        return str(refused.value)

    return refuse


@pytest.mark.parametrize(("setting", "expected", "value"), CASES)
def test_a_setting_that_makes_no_sense_is_refused(
    setting: str, expected: str, value: str, refusal: Callable[..., str]
) -> None:
    *options, name = setting.split()
    assert f"{name}: expected {expected}" in refusal(f"{name}={value}", options=tuple(options))


def test_a_run_must_hold_a_batch_and_its_warm_up(refusal: Callable[..., str]) -> None:
    said = refusal("collector.total_frames=500")
    assert "training.warmup_frames: expected at most collector.total_frames = 500" in said
    said = refusal("collector.total_frames=8", "training.warmup_frames=0")
    assert "collector.frames_per_batch: expected at most collector.total_frames = 8" in said


def test_settings_of_other_libraries_own_options_are_left_to_them(tmp_path: Path) -> None:
    config = compose_config(
        "optim._target_=torch.optim.RMSprop",
        "~optim.fused",
        "+optim.momentum=0.5",
        "~target.tau",
        "+target.eps=0.99",
        "collector.total_frames=32",
        "training.warmup_frames=16",
        "training.update_ratio=0.1",
        "evaluation.episodes=2",
        "+env.base.max_steps=4",
    )
    assert train(config, RunFolder.create(tmp_path / "run"))["steps"] == 32


@pytest.mark.parametrize(("given", "read"), [("1e4", 10_000), ("2.0", 2), ("24000", 24_000)])
def test_a_whole_number_may_have_an_exponent(
    given: str,
    read: int,
) -> None:
    config = compose_config(f"collector.total_frames={given}")
    require_settings(config)
    assert config.collector.total_frames == read
    assert isinstance(config.collector.total_frames, int)
    assert isinstance(config.optim.lr, float)


@pytest.mark.parametrize("given", ["1.5", "-1e3", "0.0", "nan"])
def test_no_other_number_is_whole(given: str) -> None:
    with pytest.raises(ValueError, match=r"collector\.total_frames: expected a whole number >= 1"):
        require_settings(compose_config(f"collector.total_frames={given}"))


def test_a_task_states_what_losses_take_unless_it_is_given() -> None:
    names = ("gamma", "target_entropy", "loss_function")

    def losses(*overrides: str) -> list[Any]:
        loss = compose_config(*overrides).loss
        return [loss[name] for name in names]

    assert losses() == [0.95, -4.0, "smooth_l1"]
    given = [f"loss.{name}={value}" for name, value in zip(names, (0.9, -1, "l1"), strict=True)]
    assert losses(*given) == [0.9, -1, "l1"]
    assert losses(*(f"~env.{name}" for name in names)) == [0.99, "auto", "l2"]
