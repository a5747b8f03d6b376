"""Loggers of services that know a run by a name of their own."""

from __future__ import annotations

import secrets
from pathlib import Path

from torchrl.record.loggers import WandbLogger

from cnfp_torchrl.whole_file import whole_file

WANDB_ID = "wandb_id"
"""The file in a run's folder with the run's name at Weights & Biases."""


def weights_and_biases(
    log_dir: str | Path, *, project: str = "cnfp_torchrl", offline: bool = False
) -> WandbLogger:
    """Return TorchRL's logger for Weights & Biases, for a run that may be gone on with.

    Args:
        log_dir: The run's folder, after which the run is called.
        project: The project at Weights & Biases.
        offline: Whether to write into the folder alone, for ``wandb sync``.

    Raises:
        ImportError: when ``wandb`` is not installed.
    """
    folder = Path(log_dir)
    known = folder / WANDB_ID
    if not known.is_file():
        with whole_file(known) as file:
            file.write(secrets.token_hex(4).encode())
    name = known.read_text().strip()
    return WandbLogger(folder.name, log_dir=str(folder), id=name, project=project, offline=offline)
