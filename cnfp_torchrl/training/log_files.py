"""The log of a run that goes on: what was written after the state that it goes on from is cut."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path

from cnfp_torchrl.whole_file import remove_partial_files, whole_file

EVALUATION = "evaluation/"
"""The beginning of the names of what evaluations during training log."""


def cut_logs(folder: Path, step: int, evaluated_at: int) -> None:
    """Remove what TorchRL's CSV and TensorBoard loggers wrote after a step, and broken last lines.

    What is removed will be written anew, so that no row is missing and none is there twice.

    Args:
        folder: A run's folder, in whose subfolders the loggers write.
        step: The last one whose entries stay.
        evaluated_at: The last one of which an evaluation stays: that of a run's end comes behind
            the state of the same step.
    """

    def last_step(name: str) -> int:
        return evaluated_at if name.startswith(EVALUATION) else step

    for path in sorted(folder.glob("*/scalars/**/*.csv")):
        remove_partial_files(path)
        last = last_step(path.as_posix().rpartition("/scalars/")[2])
        lines = path.read_bytes().splitlines(keepends=True)
        kept = [line for line in lines if line.endswith(b"\n") and int(line.split(b",")[0]) <= last]
        if kept != lines:
            with whole_file(path) as file:
                file.writelines(kept)
    for path in sorted(folder.rglob("events.out.tfevents.*")):
        remove_partial_files(path)  # which TensorBoard would read, too
        _cut_events(path, last_step)


def _cut_events(path: Path, last_step: Callable[[str], int]) -> None:
    """Write a file of TensorBoard's anew, without events after the last step of their name.

    TensorBoard would hide them by itself if told where a run goes on, other readers would not.
    """
    if importlib.util.find_spec("tensorboard") is None:
        return
    from tensorboard.backend.event_processing.event_file_loader import LegacyEventFileLoader
    from tensorboard.summary.writer.record_writer import RecordWriter

    with whole_file(path) as file:
        writer = RecordWriter(file)
        for event in LegacyEventFileLoader(str(path)).Load():
            names = [value.tag for value in event.summary.value] or [""]
            if event.step <= min(map(last_step, names)):
                writer.write(event.SerializeToString())
