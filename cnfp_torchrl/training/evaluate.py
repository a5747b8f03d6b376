"""Evaluate a trained run beside policies that learn nothing: the command ``cnfp-evaluate``."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from contextlib import AbstractContextManager, closing, nullcontext
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig

from cnfp_torchrl.configuration import config_directory
from cnfp_torchrl.modules import SafeRandomPolicy, constrain, flow_head, guarded
from cnfp_torchrl.training.agent import build_environment, load_actor
from cnfp_torchrl.training.baselines import StandStill
from cnfp_torchrl.training.evaluation import Policy, evaluate_seeded
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.settings import EvaluationSettings, require_settings
from cnfp_torchrl.training.watching import RECORDING, Watch, watch_run
from cnfp_torchrl.whole_file import whole_file


def evaluate_run(
    folder: RunFolder, settings: EvaluationSettings, *, trusted: tuple[str, ...] = ()
) -> dict[str, dict[str, Any]]:
    """Return the report of the trained policy and of each baseline.

    Args:
        folder: a finished run.
        settings: number of episodes and the seed, the same for all.
        trusted: see `RunFolder.load_config`.
    """
    config = folder.load_config(trusted)
    env = build_environment(config, batch_size=[settings.episodes], with_anchor=True)
    actor = load_actor(folder, config, env)
    safe = constrain(actor, flow="exact")
    exact = flow_head(safe)
    score = instantiate(config.env.get("score"))
    policies: dict[str, tuple[Policy, bool]] = {
        "trained, stochastic": (guarded(actor), False),
        "trained, deterministic": (guarded(actor), True),
        "safe random": (SafeRandomPolicy(safe), False),
        "standing still": (StandStill(exact), False),
    }
    for name, make in instantiate(config.env.get("baselines") or {}).items():
        policies[name] = (make(exact), False)
    reports = {}
    for name, (policy, deterministic) in policies.items():
        result = evaluate_seeded(env, policy, settings, deterministic=deterministic)
        reports[name] = result.report(score)
    return reports


def table(reports: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the reports as a text table."""
    names = list(next(iter(reports.values()))["violations"])
    header = ["policy", "return", "score", *(f"{name} violations" for name in names)]
    rows = [header]
    for name, report in reports.items():
        error = report["return_standard_error"]
        spread = "" if error is None else f" +- {error:.2f}"
        score = "-" if report["score"] is None else f"{report['score']:.3f}"
        counts = [str(report["violations"][each]) for each in names]
        rows.append([name, f"{report['return_mean']:.2f}{spread}", score, *counts])
    widths = [max(len(row[i]) for row in rows) for i in range(len(header))]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) for row in rows]
    return "\n".join(line.rstrip() for line in lines)


@hydra.main(config_path=str(config_directory()), config_name="evaluate", version_base="1.3")
def main(config: DictConfig) -> None:
    """Evaluate a run, print a table, write ``evaluation.json``, and show episodes if asked to."""
    require_settings(config)
    settings: EvaluationSettings = instantiate(config.evaluation)
    watch: Watch | None = instantiate(config.visual, _convert_="all") or None
    trusted = tuple(config.trusted)
    folder = RunFolder.open(config.run)
    place = Path(HydraConfig.get().runtime.output_dir)
    watched: AbstractContextManager[Any] = nullcontext()
    if watch is not None:
        watched = closing(watch_run(folder, settings, watch, place / RECORDING, trusted=trusted))
    with watched:
        _report(folder, settings, place, trusted)


def _report(
    folder: RunFolder, settings: EvaluationSettings, place: Path, trusted: tuple[str, ...]
) -> None:
    reports = evaluate_run(folder, settings, trusted=trusted)
    output = place / "evaluation.json"
    document = {"run": str(folder.path), "seed": settings.seed, "policies": reports}
    text = json.dumps(document, indent=2, allow_nan=False)
    with whole_file(output) as file:
        file.write(f"{text}\n".encode())
    sys.stdout.write(f"{table(reports)}\n{output}\n")


if __name__ == "__main__":
    main()
