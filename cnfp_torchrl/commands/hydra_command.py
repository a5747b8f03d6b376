"""Commands that Hydra configures: any path on their command line, and errors in a sentence."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import TypeVar

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException
from hydra.types import RunMode
from omegaconf import DictConfig

from cnfp_torchrl.commands.paths import quoted_paths
from cnfp_torchrl.commands.refusals import WITH_TRACEBACKS, errors_in_a_sentence, write_error
from cnfp_torchrl.commands.side_by_side import as_stop, begin_run, end_run, is_side_by_side
from cnfp_torchrl.configuration import config_directory, refuse_unknown_settings
from cnfp_torchrl.training.interruption import TrainingInterrupted

R = TypeVar("R")


def hydra_command(
    name: str, after_death: Callable[[], None] | None = None
) -> Callable[[Callable[[DictConfig], R]], Callable[[], None]]:
    """Return a decorator that makes a command of a function of a configuration.

    The command takes ``run=PATH`` and ``resume=PATH`` with any path. Where it fails, the cause
    comes first, in one line; in a sweep, as soon as the run has failed.

    Args:
        name: The configuration's name in ``conf/``.
        after_death: What goes on with a sweep of which a process has died, in place of an error.
    """

    def decorate(function: Callable[[DictConfig], R]) -> Callable[[], None]:
        @wraps(function)
        def run(config: DictConfig) -> R:
            if is_sweep():
                return _run_of_sweep(function, config)
            # Not left to Hydra, which prints the overrides before the cause.
            with errors_in_a_sentence():
                refuse_unknown_settings(config)
                return function(config)

        application = hydra.main(
            config_path=str(config_directory()), config_name=name, version_base="1.3"
        )(run)

        @wraps(function)
        def command() -> None:
            sys.argv[1:] = quoted_paths(sys.argv[1:])
            with errors_in_a_sentence(), _raised_by_hydra():
                try:
                    application()
                except _ToldError:
                    if WITH_TRACEBACKS:
                        raise
                    sys.exit(1)
                except BrokenProcessPool:
                    if after_death is None:
                        raise
                    after_death()

        return command

    return decorate


class _ToldError(CompactHydraException):
    """A failure of a sweep's run that was written when it happened; Hydra raises one at the end."""


def is_sweep() -> bool:
    """Tell whether the job that runs is one of a sweep."""
    return bool(HydraConfig.get().mode == RunMode.MULTIRUN)


def _run_of_sweep(function: Callable[[DictConfig], R], config: DictConfig) -> R:
    """Call a function, and write at once why it fails: Hydra raises one failure, at the end."""
    is_in_worker = is_side_by_side(HydraConfig.get())
    try:
        if is_in_worker:
            begin_run()
        refuse_unknown_settings(config)
        return function(config)
    except (SystemExit, TrainingInterrupted) as end:
        if not is_in_worker:
            raise
        # As a failure, for joblib would kill the others.
        if stop := as_stop(end):
            raise CompactHydraException(str(stop)) from end
        raise _told(RuntimeError(f"the run was left by sys.exit, with {end}")) from end
    except Exception as error:
        # Not the end of the process, which would be that of the sweep.
        raise _told(error) from error
    finally:
        if is_in_worker:
            end_run()


def _told(error: Exception) -> _ToldError:
    """Write why a run of a sweep fails, and return what Hydra may raise."""
    folder = Path(HydraConfig.get().runtime.output_dir).name
    return _ToldError(write_error(error, f"{folder}: "))


@contextmanager
def _raised_by_hydra() -> Iterator[None]:
    """Let Hydra raise its errors in this context, where it would print them and exit."""
    if WITH_TRACEBACKS:
        yield
        return
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        yield
    finally:
        del os.environ["HYDRA_FULL_ERROR"]
