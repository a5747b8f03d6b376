"""What a run leaves behind, and how it is read back without trusting it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import nn

CONFIG, CHECKPOINT, SUMMARY = "config.yaml", "checkpoint.pt", "summary.json"

TRUSTED_TARGETS = ("cnfp_torchrl.", "torchrl.envs.GymEnv")
"""What a stranger's configuration may instantiate; nothing that reads or runs a file."""


class RunFolder:
    """The folder of one training run: configuration, checkpoint, summary, metrics and figures.

    Args:
        path: the folder.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    @classmethod
    def create(cls, path: str | Path) -> RunFolder:
        """Return a new run's folder, made if need be.

        Raises:
            FileExistsError: when the folder holds a run already.
        """
        folder = cls(path)
        held = [n for n in (CONFIG, CHECKPOINT, SUMMARY) if (folder.path / n).exists()]
        if held:
            raise FileExistsError(
                f"expected an empty folder for the run, but {folder.path} holds {held} of another; "
                "give a new one with hydra.run.dir=PATH or leave it out"
            )
        folder.path.mkdir(parents=True, exist_ok=True)
        return folder

    @classmethod
    def open(cls, path: str | Path) -> RunFolder:
        """Return the folder of a finished run.

        Raises:
            FileNotFoundError: when it holds no configuration or checkpoint, naming what is missing.
        """
        folder = cls(path)
        missing = [n for n in (CONFIG, CHECKPOINT) if not (folder.path / n).is_file()]
        if missing:
            raise FileNotFoundError(
                f"run: expected the folder of a finished run with {CONFIG} and {CHECKPOINT}, but "
                f"{folder.path} lacks {missing}"
            )
        return folder

    def save_config(self, config: DictConfig) -> None:
        """Write the configuration with every interpolation resolved."""
        OmegaConf.save(config, self.path / CONFIG, resolve=True)

    def load_config(self, trusted: Sequence[str] = ()) -> DictConfig:
        """Read the configuration.

        Args:
            trusted: prefixes of further importable names that may be instantiated, such as
                ``my_package.envs.``.

        Raises:
            PermissionError: when it would instantiate anything else.
        """
        config = OmegaConf.load(self.path / CONFIG)
        if not isinstance(config, DictConfig):
            raise ValueError(f"{self.path / CONFIG}: expected a mapping, given {type(config)}")
        allowed = (*TRUSTED_TARGETS, *trusted)
        for section in ("env", "flow", "network"):
            content = OmegaConf.to_container(config[section], resolve=True)
            for target in _targets(content):
                if not target.startswith(allowed):
                    raise PermissionError(
                        f"{self.path / CONFIG}, section '{section}': expected targets that start "
                        f"with one of {list(allowed)}, given {target!r}; if you trust this run, "
                        "add its prefix: trusted=[...]"
                    )
        return config

    def save_checkpoint(self, **modules: nn.Module | torch.optim.Optimizer) -> None:
        """Write the state dicts of modules and optimizers under their names."""
        state = {name: module.state_dict() for name, module in modules.items()}
        torch.save(state, self.path / CHECKPOINT)

    def load_checkpoint(self) -> dict[str, Any]:
        """Read the state dicts; tensors and plain containers only, so no code can run."""
        return torch.load(self.path / CHECKPOINT, weights_only=True)

    def save_summary(self, summary: dict[str, Any]) -> None:
        """Write the summary."""
        text = json.dumps(summary, indent=2, allow_nan=False)
        (self.path / SUMMARY).write_text(text + "\n")


def _targets(content: Any) -> Iterator[str]:
    if isinstance(content, dict):
        for key, value in content.items():
            if key == "_target_":
                yield str(value)
            else:
                yield from _targets(value)
    elif isinstance(content, list):
        for value in content:
            yield from _targets(value)
