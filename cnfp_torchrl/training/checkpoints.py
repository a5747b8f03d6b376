"""The states from which a run goes on, in files that are data and nothing else.

Each component is any object with ``state_dict`` and ``load_state_dict``, as PyTorch's modules and
optimizers, TorchRL's collectors, loggers and samplers, and `torchrl.checkpoint.GlobalRNGState` are.
The container of `torchrl.checkpoint` is not used: as of 0.14.1 it writes through memory maps, so
that a full disk kills the process, and reading it can run code of whoever wrote it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import torch

from cnfp_torchrl.whole_file import whole_file

_STATE, _SUFFIX = "state-", ".pt"


class Stateful(Protocol):
    """Something whose state can be taken and given back."""

    def state_dict(self) -> Mapping[str, Any]:
        """Return the state: tensors, numbers, text, and containers of them."""
        ...

    def load_state_dict(self, state_dict: Any) -> Any:
        """Take a state that `state_dict` has returned."""
        ...


class Attributes:
    """The state of an object that has no ``state_dict``: some of its attributes.

    Args:
        owner: The object.
        names: The attributes' names; their values are numbers, text or tensors.
    """

    def __init__(self, owner: object, *names: str) -> None:
        self._owner, self._names = owner, names

    def state_dict(self) -> dict[str, Any]:
        """Return the attributes' values."""
        return {name: getattr(self._owner, name) for name in self._names}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Set the attributes."""
        for name in self._names:
            setattr(self._owner, name, state[name])


class CheckpointError(OSError):
    """A checkpoint cannot be written or is not the whole one that was written."""


class Checkpoints:
    """The newest states of a run, each in a file that is whole or not there.

    Args:
        path: The folder, made when it is first written to.
        keep: The number of states that are kept; the older ones serve when the newest is broken.
    """

    def __init__(self, path: Path, keep: int) -> None:
        self.path = path
        self._keep = keep

    def frames(self) -> list[int]:
        """Return the environment steps at which the states were taken, in ascending order."""
        numbers = (path.stem.removeprefix(_STATE) for path in self.path.glob(f"{_STATE}*{_SUFFIX}"))
        return sorted(int(number) for number in numbers if number.isdigit())

    def save(self, frames: int, components: Mapping[str, Stateful]) -> None:
        """Write the states of all components, and remove the file of the oldest if need be.

        Raises:
            CheckpointError: when the file cannot be written; the earlier ones stay as they are.
        """
        state = {name: component.state_dict() for name, component in components.items()}
        save_data(self._file(frames), state, self.path.parent)
        for old in self.frames()[: -self._keep]:
            self._file(old).unlink()

    def load(self, frames: int) -> dict[str, Any]:
        """Read the states that were taken at a step.

        Raises:
            CheckpointError: when the file is not what `save` wrote.
        """
        state = load_data(self._file(frames))
        if not isinstance(state, dict):
            raise CheckpointError(f"{self._file(frames)}: expected states, given {type(state)}")
        return state

    def drop_after(self, frames: int) -> None:
        """Remove the states after a step, from which the run does not go on."""
        for later in self.frames():
            if later > frames:
                self._file(later).unlink()

    def _file(self, frames: int) -> Path:
        return self.path / f"{_STATE}{frames:012d}{_SUFFIX}"


def restore(components: Mapping[str, Stateful], state: Mapping[str, Any], origin: Path) -> None:
    """Give each component its state.

    Args:
        components: The objects, by name.
        state: Their states, by the same names.
        origin: The folder that the states are from, for the message.

    Raises:
        CheckpointError: naming the component whose state is missing or does not fit.
    """
    for name, component in components.items():
        try:
            component.load_state_dict(state[name])
        except Exception as error:  # what does not fit fails in any way
            raise CheckpointError(
                f"{origin}: expected the state of {name!r} as this configuration and version write "
                f"it, given another one ({type(error).__name__}: {error}); go on with the version "
                "that wrote it, or train again"
            ) from error


def save_data(path: Path, content: Any, run: Path) -> None:
    """Write tensors, numbers, text and containers of them, whole or not at all.

    Args:
        path: The file.
        content: What is written.
        run: The run's folder, for the message.

    Raises:
        CheckpointError: when it cannot be written; what had the name before is still there.
    """
    with _writable(path, run):
        path.parent.mkdir(exist_ok=True)
        with whole_file(path) as file:
            torch.save(content, file)


def load_data(path: Path) -> Any:
    """Read what `save_data` wrote; nothing in it is executed, whoever wrote it.

    Tensors come to the device that they were on: a run goes on where it was.

    Raises:
        CheckpointError: when it is not that, or the device is not there.
    """
    try:
        return torch.load(path, weights_only=True)
    # Not from the cause: PyTorch advises to load what it refused in a way that runs code.
    except Exception as error:  # the readers of its formats fail in any way
        reason = type(error).__name__
        if "is_available() is False" in str(error):
            reason = "tensors of a device that is not there"
        raise CheckpointError(
            f"{path}: expected tensors and plain containers, whole as training wrote them, given "
            f"something else ({reason}); copy the file anew from where the run was trained"
        ) from None


@contextmanager
def _writable(path: Path, run: Path) -> Iterator[None]:
    """Name the file that cannot be written, and what to do.

    PyTorch tells of a full disk by a RuntimeError, which does not say so.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        cause = error.__context__ if isinstance(error.__context__, OSError) else error
        raise CheckpointError(
            f"{path}: could not be written ({cause}); the states before it are whole. Make room, "
            f"or the folder writable, and go on with: cnfp-train resume={run}"
        ) from error
