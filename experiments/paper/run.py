"""Do the runs of the report, some side by side, and keep a record of each.

    python -m experiments.paper.run [key=value ...]

``sweep.yaml`` says which methods, seeds and budget, and where to; every key of ``conf/train.yaml``
can be overridden. What has a record already is not run again, so the same command goes on where it
was stopped. A run that fails does not hold up the others; the exit status tells.
"""

from __future__ import annotations

import json
import logging
import os
import platform
import signal
from collections.abc import Mapping
from contextlib import redirect_stderr
from importlib.metadata import version
from pathlib import Path
from typing import Any

import hydra
from filelock import FileLock
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from cnfp_torchrl.training.run_folder import SUMMARY, RunFolder
from cnfp_torchrl.training.train import train
from cnfp_torchrl.visual.figures import read_scalars
from experiments.checkout import commit
from experiments.paper.afterwards import evaluate_afterwards
from experiments.paper.records import (
    Evaluation,
    Outcome,
    Record,
    Series,
    differences,
    record_path,
)

PRESENTATION = ("figures", "hydra", "logger", "visual")
"""Sections of the training configuration that change nothing in a result; not recorded."""

PACKAGES = ("cnfp_torchrl", "torch", "torchrl", "tensordict", "numpy")

_LOG = logging.getLogger(__name__)


@hydra.main(config_path=".", config_name="sweep", version_base="1.3")
def main(config: DictConfig) -> None:
    """Do one run of the sweep, unless its record is there already."""
    job = HydraConfig.get()
    method, folder = job.runtime.choices["experiment"], Path(job.runtime.output_dir)
    own = ("experiment", "seed", *PRESENTATION)
    overrides = [
        override for override in job.overrides.task if override.split("=", 1)[0] not in own
    ]
    try:
        # Another command that does the same run is waited for; its record then is taken.
        with (
            FileLock(folder / ".lock"),
            (folder / "output.log").open("a") as log,
            redirect_stderr(log),
        ):
            said = do_run(config, method, overrides, folder, Path(job.sweep.dir) / "data")
    except Exception:
        # Hydra tells of the first failure alone, and when all is over.
        _LOG.exception("FAILED: %s, seed %s, in %s", method, config.seed, folder)
        raise
    _LOG.info("%s, seed %s: %s", method, config.seed, said)


def do_run(
    config: DictConfig, method: str | None, overrides: list[str], folder: Path, data: Path
) -> str:
    """Train and keep the record, unless it is there already; return what was done, in words.

    Args:
        config: The configuration of the training, as composed.
        method: The name of the experiment.
        overrides: What was given beside experiment and seed.
        folder: The folder of this run. Each attempt has a folder in it, those of killed ones are
            left as they are; a finished attempt is not repeated.
        data: The folder of the records.

    Raises:
        RecordError: when the record that is there cannot be read.
        ValueError: when it is one of a run with another configuration, or no method is named.
    """
    if method is None:
        raise ValueError("experiment: expected the name of a method, given null")
    content = OmegaConf.to_container(config, resolve=True)
    assert isinstance(content, dict)
    path, wanted = record_path(data, method, config.seed), settings(content)
    if path.exists():
        if differing := _differing(Record.read(path).config, wanted):
            raise ValueError(
                f"{path}: expected a run with the configuration asked for, given one that differs "
                f"in {differing}; take another folder, hydra.sweep.dir=PATH, or move the file away"
            )
        return f"done before, {path}"
    attempts = sorted(folder.glob("attempt_*"))
    for attempt in attempts:
        run = RunFolder(attempt)
        if (attempt / SUMMARY).is_file() and settings(run.load_settings()) == wanted:
            break
    else:
        run = RunFolder.create(folder / f"attempt_{1 + len(attempts)}")
        train(config, run)
    return f"done, {make_record(run, method, overrides).save(data)}"


def make_record(folder: RunFolder, method: str, overrides: list[str]) -> Record:
    """Return the record of a finished run, with what its policy does afterwards.

    Args:
        folder: The folder of a run with the CSV logger.
        method: See `do_run`.
        overrides: See `do_run`.
    """
    summary = json.loads((folder.path / SUMMARY).read_text())
    curves = read_scalars(folder.path / "metrics")
    return Record(
        method=method,
        seed=summary["seed"],
        overrides=tuple(overrides),
        config=settings(folder.load_settings()),
        versions=versions(),
        commit=commit(),
        steps=summary["steps"],
        seconds=summary["seconds"],
        curves={
            name: Series(
                steps=tuple(int(step) for step in steps),
                values=tuple(_short(float(value)) for value in values),
            )
            for name, (steps, values) in curves.items()
        },
        training_violations=summary["training_violations"],
        evaluation=Evaluation(
            **{name: Outcome.of(report) for name, report in summary["evaluation"].items()}
        ),
        afterwards=evaluate_afterwards(folder),
    )


def settings(config: Mapping[Any, Any]) -> dict[str, Any]:
    """Return what decides a run's result, as JSON would give it back.

    Args:
        config: Plain data, with every interpolation resolved.
    """
    return json.loads(
        json.dumps({name: value for name, value in config.items() if name not in PRESENTATION})
    )


def versions() -> dict[str, str]:
    """Return the versions of what computes, and the kind of machine."""
    return {
        "python": platform.python_version(),
        **{name: version(name) for name in PACKAGES},
        "platform": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
    }


def _differing(given: dict[str, Any], wanted: dict[str, Any]) -> list[str]:
    return [
        f"{name} ({'absent' if one is None else one}, asked for "
        f"{'absent' if other is None else other})"
        for name, (one, other) in differences(given, wanted).items()
    ]


def _short(value: float) -> float:
    """Return the value with as many digits as a figure shows; counts stay whole."""
    return value if value.is_integer() else float(f"{value:.6g}")


if __name__ == "__main__":
    # As Ctrl-C does, so that no run goes on when the sweep is stopped.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    main()
