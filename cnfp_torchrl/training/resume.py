"""The configuration of a run that goes on: its own, with little that may be changed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from cnfp_torchrl.training.run_folder import RunFolder

CHANGEABLE = ("collector.total_frames", "checkpoint", "figures", "visual")
"""The keys and sections that may be given anew: how long, and what is seen and kept of it."""

_OF_THE_COMMAND = ("resume", "trusted", "hydra")


def resumed_config(
    folder: RunFolder, composed: DictConfig, overrides: Sequence[str], trusted: Sequence[str] = ()
) -> DictConfig:
    """Return the configuration of a run, with the overrides that do not change what it is.

    Args:
        folder: The run's folder.
        composed: The configuration that these overrides give with the defaults.
        overrides: Those of the command line, as Hydra takes them.
        trusted: See `RunFolder.load_training_config`.

    Raises:
        ValueError: naming the key that would change what is gone on with, or fewer steps.
        PermissionError: see `RunFolder.load_training_config`.
    """
    config = folder.load_training_config(trusted)
    if "checkpoint" not in config:  # of a version before there were any
        config.checkpoint = composed.checkpoint
    before = config.collector.total_frames
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.key_or_group.replace("/", ".")
        if key.partition(".")[0] in _OF_THE_COMMAND:
            continue
        given = _value(composed, key)
        if any(f"{key}.".startswith(f"{name}.") for name in CHANGEABLE):
            OmegaConf.update(config, key, given, merge=False, force_add=True)
        elif given is None or given != _value(config, key):
            began = OmegaConf.select(config, key)
            was = "" if OmegaConf.is_config(began) else f" {began!r}"
            raise ValueError(
                f"{key}: expected what the run in {folder.path} began with{was}, given "
                f"{override.input_line!r}; leave it out, for a run goes on by its own "
                f"configuration (but for {', '.join(CHANGEABLE)}), or start a new run"
            )
    total = config.collector.total_frames
    if total < before:
        raise ValueError(
            f"collector.total_frames: expected at least the {before} steps that the run was begun "
            f"with, given {total}; leave it out, or give more"
        )
    return config


def _value(config: DictConfig, key: str) -> Any:
    """Return a value or a section as plain data, None where there is none."""
    value = OmegaConf.select(config, key)
    return OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
