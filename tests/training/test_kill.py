"""Runs that are killed at random moments, or stopped at any touch of their folder."""

import errno
import itertools
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.training.resume import resumed_config
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.train import train
from experiments.resume import differences, killed_runs

from .conftest import TINY


@pytest.mark.slow
def test_runs_killed_at_random_moments_end_as_one_that_was_not(tmp_path: Path) -> None:
    rows = list(killed_runs(tmp_path, kills=20, steps=1600, seed=1))
    assert rows
    assert [row[2] for row in rows] == ["nothing"] * len(rows)


# States and a best policy are written and replaced, the older ones removed with their transitions.
SETTINGS = [
    *TINY,
    "evaluation.episodes=1",
    "evaluation.interval=96",
    "checkpoint.interval=64",
    "checkpoint.keep=1",
    "replay_buffer.storage.max_size=72",
]


def exit_code(work: Callable[[], Any]) -> int | None:
    """Return the exit code of a process that does some work and knows all that this one does."""
    process = multiprocessing.get_context("fork").Process(target=work)
    process.start()
    process.join()
    return process.exitcode


def before_touches(folder: Path, numbers: range, act: Callable[[str, str], None]) -> None:
    """Act before some of the times that a file is opened for writing, renamed, linked or removed.

    Those of TensorBoard's do not count: a thread writes them when it likes. There is no way back
    for the process.
    """
    count = itertools.count(1)

    def hook(event: str, given: tuple[Any, ...]) -> None:
        if event not in ("open", "os.rename", "os.link", "os.remove"):
            return
        name = os.fsdecode(given[0]) if isinstance(given[0], str | bytes | os.PathLike) else ""
        is_read = event == "open" and not given[2] & (os.O_WRONLY | os.O_RDWR)
        if is_read or not name.startswith(f"{folder}/") or "tensorboard" in name:
            return
        if next(count) in numbers:
            act(event, name)

    sys.addaudithook(hook)


def kill(event: str, name: str) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def terminate(event: str, name: str) -> None:
    os.kill(os.getpid(), signal.SIGTERM)


def fill_the_disk(event: str, name: str) -> None:
    if event != "os.remove":
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), name)


def begin(path: Path, first: int, act: Callable[[str, str], None]) -> None:
    before_touches(path, range(first, 10**9 if act is fill_the_disk else first + 1), act)
    train(compose_config(*SETTINGS), RunFolder.create(path))


def go_on(path: Path) -> None:
    folder = RunFolder.resume(path)
    train(resumed_config(folder, compose_config(), []), folder, resume=True)


@pytest.mark.slow
@pytest.mark.parametrize("act", [kill, terminate, fill_the_disk])
def test_runs_stopped_at_any_touch_of_their_folder_end_as_one_that_was_not(
    act: Callable[[str, str], None], tmp_path: Path
) -> None:
    train(compose_config(*SETTINGS), RunFolder.create(tmp_path / "whole"))
    resumed = 0
    for first in itertools.count(1):
        path = tmp_path / str(first)
        if exit_code(partial(begin, path, first, act)) == 0:
            break  # it ended before the touch
        if RunFolder(path).has_started and not RunFolder(path).is_complete:
            assert exit_code(partial(go_on, path)) == 0, first
            assert not differences(tmp_path / "whole", path), first
            assert not list(path.rglob("*.partial")), first
            resumed += 1
    assert resumed > 20
