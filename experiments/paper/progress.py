"""The display over all runs: bars on a terminal, lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from types import TracebackType
from typing import Protocol

from tqdm import tqdm

from experiments.paper.jobs import RunningJob


class Progress(Protocol):
    """What a runner tells while it goes on."""

    def say(self, line: str) -> None:
        """Tell something that stays."""

    def show(self, running: Sequence[RunningJob], finished: int, failed: int) -> None:
        """Show how far all is."""

    def __enter__(self) -> Progress: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None: ...


class Bars:
    """One bar over the steps of all runs, and one for each that is under way.

    Args:
        runs: how many are to be done.
        steps: of each.
        parallel: how many at the same time.
    """

    def __init__(self, runs: int, steps: int, parallel: int) -> None:
        self._runs, self._steps = runs, steps
        common = {"unit": "step", "dynamic_ncols": True, "file": sys.stderr}
        self._all = tqdm(total=runs * steps, desc="all runs", position=0, **common)
        self._each = [
            tqdm(total=steps, desc="-", position=1 + i, leave=False, **common)
            for i in range(parallel)
        ]

    def say(self, line: str) -> None:
        """Write a line above the bars."""
        tqdm.write(line, file=sys.stderr)

    def show(self, running: Sequence[RunningJob], finished: int, failed: int) -> None:
        """Move the bars."""
        for i, bar in enumerate(self._each):
            job = running[i] if i < len(running) else None
            name = "-" if job is None else f"{job.job.name}, {job.stage}"
            if bar.desc != f"{name}: ":
                bar.reset(self._steps)
                bar.set_description(name, refresh=False)
            _move(bar, 0 if job is None else job.steps)
        done = (finished + failed) * self._steps + sum(job.steps for job in running)
        text = f"{finished} of {self._runs} runs done" + (f", {failed} FAILED" if failed else "")
        self._all.set_postfix_str(text, refresh=False)
        _move(self._all, done)

    def __enter__(self) -> Bars:
        return self

    def __exit__(self, *_: object) -> None:
        for bar in reversed([self._all, *self._each]):
            bar.close()


class Lines:
    """A line now and then, for files and pipes.

    Args:
        runs: how many are to be done.
        steps: of each.
        pause: seconds between two lines about how far all is.
    """

    def __init__(self, runs: int, steps: int, pause: float = 60.0) -> None:
        self._runs, self._steps, self._pause = runs, steps, pause
        self._next = time.monotonic() + pause

    def say(self, line: str) -> None:
        """Write a line."""
        sys.stderr.write(f"{line}\n")
        sys.stderr.flush()

    def show(self, running: Sequence[RunningJob], finished: int, failed: int) -> None:
        """Write how far all is, when it is time."""
        if time.monotonic() < self._next:
            return
        self._next += self._pause
        under_way = "; ".join(f"{each.job.name} at {each.steps:,}" for each in running)
        failures = f", {failed} FAILED" if failed else ""
        self.say(f"{finished} of {self._runs} runs done{failures}; {under_way}")

    def __enter__(self) -> Lines:
        return self

    def __exit__(self, *_: object) -> None:
        return None


def make_progress(runs: int, steps: int, parallel: int) -> Progress:
    """Return the display that fits where standard error goes."""
    return Bars(runs, steps, parallel) if sys.stderr.isatty() else Lines(runs, steps)


def _move(bar: tqdm[None], to: int) -> None:
    bar.update(to - bar.n)
    bar.refresh()
