"""Train a policy on a constrained environment: the command ``cnfp-train``."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from cnfp_torchrl.commands.extras import needs_extra

with needs_extra("train"):
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from hydra.utils import instantiate
    from omegaconf import DictConfig, OmegaConf

    from cnfp_torchrl.commands.paths import takes_any_path
    from cnfp_torchrl.commands.refusals import told_in_a_sentence
    from cnfp_torchrl.configuration import config_directory
    from cnfp_torchrl.training.constraint_counts import NOT_COUNTED, count_text, gave_way_text
    from cnfp_torchrl.training.interruption import TrainingInterrupted
    from cnfp_torchrl.training.resume import resumed_config
    from cnfp_torchrl.training.run_folder import CONFIG, RunFolder
    from cnfp_torchrl.training.train import train
    from cnfp_torchrl.whole_file import whole_file

_HYDRA_FILES = ("config", "hydra", "overrides")


def _save_hydra_files(folder: RunFolder, config: DictConfig) -> None:
    """Write Hydra's own files, which Hydra would write over those of a run that has the folder."""
    hydra_config = HydraConfig.get()
    contents = [config, {"hydra": hydra_config}, hydra_config.overrides.task]
    directory = folder.path / ".hydra"
    directory.mkdir(exist_ok=True)
    for name, content in zip(_HYDRA_FILES, contents, strict=True):
        with whole_file(directory / f"{name}.yaml") as file:
            file.write(OmegaConf.to_yaml(content).encode())


def _remove_unless_started(folder: RunFolder) -> None:
    """Remove what a run leaves that was refused before it started: Hydra's files, and the folder.

    Anything else in the folder stays, and the folder with it.
    """
    if (folder.path / CONFIG).exists():
        return
    log = folder.path / f"{HydraConfig.get().job.name}.log"
    if log.exists() and not log.stat().st_size:
        log.unlink()
    for file in _HYDRA_FILES:
        (folder.path / ".hydra" / f"{file}.yaml").unlink(missing_ok=True)
    with suppress(OSError):
        (folder.path / ".hydra").rmdir()
        folder.path.rmdir()


def _summary_text(summary: Mapping[str, Any]) -> str:
    """Return a line of results, and one for each constraint that gave way or was broken."""
    counts = ", ".join(f"{name} {count_text(n)}" for name, n in summary["violations"].items())
    score = "" if summary["score"] is None else f", score {summary['score']:.3f}"
    lines = [
        f"return {summary['return_mean']:.2f}{score}; violations: {counts or NOT_COUNTED}; "
        f"{summary['steps']} steps in {summary['seconds']:.0f} s"
    ]
    for name, report in summary["constraints"].items():
        if text := gave_way_text(report):
            lines.append(f"{name} {text}")
    return "\n".join(lines)


@takes_any_path
@hydra.main(config_path=str(config_directory()), config_name="train", version_base="1.3")
def main(config: DictConfig) -> float | None:
    """Train, draw the run's figures, print the summary, and return the score for sweeps."""
    with told_in_a_sentence():
        if config.resume is None:
            folder = RunFolder.create(HydraConfig.get().runtime.output_dir)
            _save_hydra_files(folder, config)
        else:
            folder = RunFolder.resume(config.resume)
            overrides = HydraConfig.get().overrides.task
            config = resumed_config(folder, config, overrides, config.trusted)
        try:
            summary = train(config, folder, resume=folder.has_started)
        except TrainingInterrupted as stop:
            sys.stderr.write(f"{stop}\n")
            sys.exit(128 + stop.number)
        finally:
            _remove_unless_started(folder)
        if config.figures:
            instantiate(config.figures)(folder)
        sys.stdout.write(f"{_summary_text(summary)}\n{folder.path}\n")
        return summary["score"]


if __name__ == "__main__":
    main()
