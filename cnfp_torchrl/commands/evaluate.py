"""Evaluate a trained run and baselines that learn nothing: the command ``cnfp-evaluate``."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, closing, nullcontext
from pathlib import Path
from typing import Any

from cnfp_torchrl.commands.extras import needs_extra

with needs_extra("train"):
    from hydra.core.hydra_config import HydraConfig
    from hydra.utils import instantiate
    from omegaconf import DictConfig

    from cnfp_torchrl.commands.hydra_command import hydra_command
    from cnfp_torchrl.configuration import require_settings
    from cnfp_torchrl.text_table import text_table
    from cnfp_torchrl.training.callbacks import RECORDING, CallbackFactory, show_episodes
    from cnfp_torchrl.training.constraint_counts import count_text, gave_way_text
    from cnfp_torchrl.training.evaluation import evaluate_run
    from cnfp_torchrl.training.run_folder import RunFolder
    from cnfp_torchrl.training.settings import EvaluationSettings
    from cnfp_torchrl.whole_file import write_json


def evaluation_table(reports: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the reports of `evaluate_run` as text: a table, and what gave way."""
    names = list(next(iter(reports.values()))["violations"])
    rows = [["policy", "return", "score", *(f"{name} violations" for name in names)]]
    for policy, report in reports.items():
        error = report["return_standard_error"]
        spread = "" if error is None else f" +- {error:.2f}"
        score = "-" if report["score"] is None else f"{report['score']:.3f}"
        counts = [count_text(report["violations"][name]) for name in names]
        rows.append([policy, f"{report['return_mean']:.2f}{spread}", score, *counts])
    return "\n".join([text_table(rows), *_gave_way(reports)])


def _gave_way(reports: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Yield a line for each constraint that gave way under a policy."""
    for policy, report in reports.items():
        for name, counts in report["constraints"].items():
            if text := gave_way_text(counts):
                yield f"{policy}: {name} {text}"


@hydra_command("evaluate")
def main(config: DictConfig) -> None:
    """Evaluate a run, print a table, write ``evaluation.json``, and show episodes if asked to.

    The last line names the recording, where there is one.
    """
    require_settings(config)
    settings: EvaluationSettings = instantiate(config.evaluation)
    visual: CallbackFactory | None = instantiate(config.visual, _convert_="all") or None
    trusted = config.trusted
    folder = RunFolder.open(config.run, config.checkpoint)
    directory = Path(HydraConfig.get().runtime.output_dir)
    stream: AbstractContextManager[Any] = nullcontext()
    recording = directory / RECORDING
    if visual is not None:
        stream = closing(show_episodes(folder, settings, visual, recording, trusted=trusted))
    with stream:
        reports = evaluate_run(folder, settings, trusted=trusted)
        output = directory / "evaluation.json"
        write_json(
            output,
            {
                "run": str(folder.path),
                "checkpoint": folder.checkpoint,
                "seed": settings.seed,
                "policies": reports,
            },
        )
        sys.stdout.write(f"{evaluation_table(reports)}\n{output}\n")
    if recording.exists():
        sys.stdout.write(f"next: cnfp-view {shlex.quote(str(recording))}\n")


if __name__ == "__main__":
    main()
