"""Signals that ask a run to stop, which end it when its state is saved."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import resource_tracker
from types import FrameType
from typing import Any, Self

STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT)
"""The signals that ask a run to stop; the second is Ctrl-C's."""


@contextmanager
def starting_workers() -> Iterator[None]:
    """Let processes that are started here live through the signals that stop a run after its step.

    A terminal sends Ctrl-C to all its processes, and Slurm SIGTERM to all of a job: workers that
    ended by it would take the step with them. They end with the run; one that does not answer is
    killed, as TorchRL does in the end. A signal that comes meanwhile reaches this process when
    they are started.
    """
    # Otherwise started with the first worker, after which it lets the signals through.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class TrainingInterrupted(BaseException):
    """A run was asked to stop.

    No `Exception`, which Hydra would take for a failure and go on with the next run of a sweep.

    Args:
        number: The number of the signal.
        message: The sentence that says how to go on.
    """

    def __init__(self, number: int, message: str) -> None:
        super().__init__(message)
        self.number = number

    def __reduce__(self) -> tuple[Any, ...]:
        return TrainingInterrupted, (self.number, str(self))


class StopRequest:
    """Remembers SIGTERM and Ctrl-C while it is entered; a second one ends the run at once.

    The same one within a second is no second one: a sweep passes on what a terminal or Slurm may
    have told its runs already.

    Outside of the main thread, where Python takes no signals, nothing is changed.

    Args:
        at_once: Sentence that says how to go on after a second one.
        signals: Numbers of the signals; none changes nothing.
    """

    def __init__(self, at_once: str, signals: Sequence[int] = STOP_SIGNALS) -> None:
        self._at_once, self._signals = at_once, signals
        self.signal: int | None = None
        """The number of the signal that came, or None."""
        self._came = 0.0
        self._last_words: str | None = None
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._previous = {n: signal.signal(n, self._remember) for n in self._signals}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    @contextmanager
    def ending_at_once(self, message: str) -> Iterator[None]:
        """End by a signal at once, for work that begins anew when the run goes on.

        Args:
            message: The sentence that says how to go on.

        Raises:
            TrainingInterrupted: when a signal comes, or has come before.
        """
        if self.signal is not None:
            raise TrainingInterrupted(self.signal, message)
        self._last_words = message
        try:
            yield
        finally:
            self._last_words = None

    def _remember(self, number: int, frame: FrameType | None) -> None:
        if self._last_words is not None:
            raise TrainingInterrupted(number, self._last_words)
        now = time.monotonic()
        if self.signal == number and now - self._came < 1:
            return
        if self.signal is not None:
            raise TrainingInterrupted(number, self._at_once)
        self.signal, self._came = number, now
        name = signal.Signals(number).name
        sys.stderr.write(f"\n{name}: the run stops after this step and saves; again: at once\n")
