"""The names of the runs' folders in sweeps that Hydra starts, and which sweeps were started."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from cnfp_torchrl.commands.side_by_side import is_side_by_side, stop_when_runs_are_saved

LONGEST = 80
"""Characters of a folder's name; the number before it keeps names apart that are cut."""

MULTIRUN = "multirun.yaml"
"""What Hydra writes of a sweep into its folder."""

STARTED: list[Path] = []
"""The folders of the sweeps that this process has started."""


class SweepStart(Callback):
    """Remembers a sweep's folder, for the table at its end, which also comes after a failure.

    Hydra itself calls nothing after a sweep with a failed run.
    """

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Remember the folder, and begin no more workers than runs."""
        STARTED.append(Path(str(config.hydra.sweep.dir)).absolute())
        if not is_side_by_side(config.hydra):
            return
        stop_when_runs_are_saved(STARTED[-1])
        # A worker that has no run would die of a signal, and joblib then kills those that save.
        hydra: Any = OmegaConf.to_container(config.hydra)
        if runs := _runs_of(hydra, STARTED[-1]):
            with read_write(config), open_dict(config):
                config.hydra.launcher.n_jobs = min(_processes(hydra), len(runs))


def run_name(number: int, overrides: Sequence[str], constant: Sequence[str]) -> str:
    """Return the name of a run's folder: its number and what was varied, such as ``3_seed-1``.

    Args:
        number: The run's number in the sweep.
        overrides: All overrides of the run.
        constant: The keys that all runs have in common.
    """
    varied = (override.lstrip("+~").partition("=") for override in overrides)
    parts = [
        f"{re.split('[./@]', key)[-1]}-{_short(value)}"
        for key, _, value in varied
        if key not in constant
    ]
    # Letters, digits and dots alone, so that neither shell nor Hydra reads anything into a path.
    name = "_".join([str(number), *(re.sub(r"[^\w.+]+", "-", part).strip("-") for part in parts)])
    return name[:LONGEST].rstrip("-._")


def _short(value: str) -> str:
    """Return a number with few digits, and everything else as it is."""
    try:
        return value if len(value) < 7 else f"{float(value):.4g}"
    except ValueError:
        return value


# In every process that runs a job: Hydra sends callbacks there, and with them this module.
OmegaConf.register_new_resolver("run_name", run_name, replace=True)


def planned_runs(folder: Path) -> dict[Path, list[str]]:
    """Return the overrides of all runs of a sweep, by the folders that Hydra would give them.

    A study decides while it goes on which runs it has: of it nothing is known.
    """
    path = folder / MULTIRUN
    if not path.is_file():
        return {}
    return _runs_of(yaml.safe_load(path.read_text(encoding="utf-8"))["hydra"], folder)


def _runs_of(settings: dict[str, Any], folder: Path) -> dict[Path, list[str]]:
    """Return what `planned_runs` does, of Hydra's own settings."""
    if not settings["sweeper"]["_target_"].endswith(".BasicSweeper"):
        return {}
    always = [f"{key}={value}" for key, value in (settings["sweeper"]["params"] or {}).items()]
    choices = {}
    parser = OverridesParser.create()
    for override in parser.parse_overrides([*always, *settings["overrides"]["task"]]):
        if isinstance(override.value(), Glob):
            return {}  # means what it finds, which may have changed
        key = override.get_key_element()
        if override.is_sweep_override():
            values = list(override.sweep_string_iterator())
        else:
            values = [override.get_value_element_as_str()]
        choices[key] = [f"{key}={value}" for value in values]
    constant = settings["job"]["config"]["override_dirname"]["exclude_keys"]
    runs = map(list, product(*choices.values()))
    return {
        folder / run_name(i, overrides, constant): overrides for i, overrides in enumerate(runs)
    }


def processes(folder: Path) -> int:
    """Return how many runs of a sweep that Hydra has started go side by side."""
    return _processes(yaml.safe_load((folder / MULTIRUN).read_text(encoding="utf-8"))["hydra"])


def _processes(settings: dict[str, Any]) -> int:
    from joblib import effective_n_jobs  # of the extra `sweep`, without which nothing is parallel

    count: int = effective_n_jobs(settings["launcher"].get("n_jobs") or 1)
    return count


def config_arguments(folder: Path) -> list[str]:
    """Return the arguments that gave a sweep the folder of the user's own configurations."""
    path = folder / MULTIRUN
    if not path.is_file():
        return []
    sources = yaml.safe_load(path.read_text(encoding="utf-8"))["hydra"]["runtime"]["config_sources"]
    given = [source["path"] for source in sources if source["provider"] == "command-line"]
    return [part for directory in given for part in ("--config-dir", directory)]


def with_common_keys(arguments: Sequence[str]) -> list[str]:
    """Return the arguments of a command, those of a sweep with the keys that its runs share."""
    if not {"-m", "--multirun"} & set(arguments):
        return list(arguments)
    common, behind = [], 0
    for number, argument in enumerate(arguments, start=1):
        try:
            override = OverridesParser.create().parse_override(argument)
        except HydraException:
            continue  # an option, or what Hydra will refuse in its own words
        if not override.is_sweep_override() and not argument.startswith("hydra"):
            common.append(override.get_key_element().lstrip("+~"))
            behind = number
    if not common:
        return list(arguments)
    quoted = ",".join(f"'{key}'" for key in common)
    excluded = f"hydra.job.config.override_dirname.exclude_keys=[{quoted}]"
    # Beside another override: the parser of the command line takes them in one row alone.
    return [*arguments[:behind], excluded, *arguments[behind:]]
