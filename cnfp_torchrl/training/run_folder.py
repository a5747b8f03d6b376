"""The folder of a run: what training writes, and reading it back without trust."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import pickle
import shlex
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import nn

from cnfp_torchrl.configuration.trust import BUILT, read_plain, require_trusted, targets
from cnfp_torchrl.training.checkpoints import CheckpointError, save_data
from cnfp_torchrl.whole_file import remove_partial_files, whole_file, write_json

CONFIG, CHECKPOINT, SUMMARY = "config.yaml", "checkpoint.pt", "summary.json"
FAILURE = "failure.json"
BEST = "best.pt"
"""The policy of the best score in training, in the form of the last one's `CHECKPOINT`."""
STATES = "checkpoints"
"""The folder of the states that a run goes on from."""

_OF_THE_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)


class RunFolder:
    """The folder of one training run: configuration, checkpoint, summary, metrics and figures.

    Args:
        path: The folder.
        checkpoint: The name of the file that policies are read from.
    """

    def __init__(self, path: str | Path, checkpoint: str = CHECKPOINT) -> None:
        self.path = Path(path)
        self.checkpoint = checkpoint
        self._release: Callable[[], Any] | None = None

    def close(self) -> None:
        """Let go of the folder; a run that has started keeps it by its configuration."""
        if self._release is not None:
            self._release()

    @classmethod
    def create(cls, path: str | Path) -> RunFolder:
        """Return a new run's folder, made if need be and held until closed, or gone.

        Raises:
            FileExistsError: when the folder holds a run already, or another process holds it.
        """
        folder = cls(path)
        folder.path.mkdir(parents=True, exist_ok=True)
        expected = "expected an empty folder for the run"
        remedy = "give a new one with hydra.run.dir=PATH or leave it out"
        if not folder._hold():
            raise FileExistsError(f"{expected}, but another run works in {folder.path}; {remedy}")
        if held := [n for n in (CONFIG, CHECKPOINT, SUMMARY) if (folder.path / n).exists()]:
            folder.close()
            raise FileExistsError(
                f"{expected}, but {folder.path} holds {held} of another; {remedy}"
            )
        return folder

    def _hold(self) -> bool:
        """Lock the folder itself, which leaves nothing in it, and tell whether nobody else did."""
        handle = os.open(self.path, os.O_RDONLY)
        self._release = weakref.finalize(self, os.close, handle)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.close()
            return False
        except OSError:
            # Some network file systems cannot lock a folder: there `save_config` decides, later.
            self.close()
        return True

    @classmethod
    def resume(cls, path: str | Path) -> RunFolder:
        """Return the folder of a run that is to go on, held until closed, or gone.

        Raises:
            FileNotFoundError: when it is not the folder of a run that has started.
            FileExistsError: when another process works in it.
        """
        folder = cls(path)
        if not (folder.path / CONFIG).is_file():
            raise FileNotFoundError(
                f"resume: expected the folder of a run, with {CONFIG}, but {folder.path} has none; "
                "give the folder that training printed"
            )
        if not folder._hold():
            raise FileExistsError(
                f"resume: expected a run that was stopped, but one works in {folder.path}; wait "
                "for it, or stop it"
            )
        return folder

    @property
    def has_started(self) -> bool:
        """Tell whether a run has written its configuration."""
        return (self.path / CONFIG).is_file()

    @property
    def is_held(self) -> bool:
        """Tell whether a process works in the folder, which can be told on its machine alone."""
        if not self._hold():
            return True
        self.close()
        return False

    @property
    def is_finished(self) -> bool:
        """Tell whether training has ended and written its summary."""
        return (self.path / SUMMARY).is_file()

    @property
    def is_complete(self) -> bool:
        """Tell whether the run is finished with all steps that its configuration asks for."""
        if not self.is_finished:
            return False
        wanted: int = self.load_settings()["collector"]["total_frames"]
        return bool(self.load_summary()["steps"] >= wanted)

    @classmethod
    def open(cls, path: str | Path, checkpoint: str = CHECKPOINT) -> RunFolder:
        """Return the folder of a finished run.

        Args:
            path: The folder.
            checkpoint: The name of the file with the policy: `CHECKPOINT`, the last one, or `BEST`.

        Raises:
            FileNotFoundError: when it holds no configuration or checkpoint, naming what is missing.
            ValueError: for any other name of a checkpoint.
        """
        if checkpoint not in (CHECKPOINT, BEST):
            raise ValueError(
                f"checkpoint: expected {CHECKPOINT}, the last policy, or {BEST}, the best one of "
                f"training, given {checkpoint!r}"
            )
        folder = cls(path, checkpoint)
        missing = [n for n in (CONFIG, checkpoint) if not (folder.path / n).is_file()]
        if missing == [BEST] and (folder.path / CHECKPOINT).is_file():
            raise FileNotFoundError(
                f"checkpoint: expected {BEST} in {folder.path}, which has none, for no policy was "
                f"scored in training without a violation; take the last one, {CHECKPOINT}"
            )
        if missing:
            raise FileNotFoundError(
                f"run: expected the folder of a finished run with {CONFIG} and {checkpoint}, but "
                f"{folder.path} lacks {missing}; give the folder that training printed when it "
                f"ended, finish the run with cnfp-train resume={folder.path}, or train again"
            )
        return folder

    def save_config(self, config: DictConfig) -> None:
        """Write the configuration with every interpolation resolved.

        Raises:
            FileExistsError: when another run has written its own in the meantime.
        """
        with whole_file(self.path / CONFIG, exclusive=True) as file:
            file.write(OmegaConf.to_yaml(config, resolve=True).encode())

    def replace_config(self, config: DictConfig) -> None:
        """Write the configuration of a run that goes on with other settings than before."""
        with whole_file(self.path / CONFIG) as file:
            file.write(OmegaConf.to_yaml(config, resolve=True).encode())

    def load_settings(self) -> dict[str, Any]:
        """Read the configuration as plain data, to be compared or shown but not built.

        Raises:
            ValueError: when it is not plain YAML.
        """
        return read_plain(self.path / CONFIG)

    def load_config(self, trusted: Sequence[str] = ()) -> DictConfig:
        """Read what the run can be built from: no section of it names anything untrusted.

        Sections of training alone, such as the optimizer's, are left out; `load_settings` has them.

        Args:
            trusted: Packages, modules or objects that may be named beside what the shipped
                configuration names, such as ``my_package.envs.``.

        Raises:
            ValueError: when it is not plain YAML, lacks a section, or is of version 0.1.
            PermissionError: when it would do anything else than build what it may name.
        """
        content = self._known_settings()
        content = {
            name: section
            for name, section in content.items()
            if name in BUILT or not any(True for _ in targets(section))
        }
        require_trusted(content, trusted, self.path / CONFIG)
        return OmegaConf.create(content)

    def load_training_config(self, trusted: Sequence[str] = ()) -> DictConfig:
        """Read what the run can be trained further from: all of its configuration.

        Args:
            trusted: See `load_config`.

        Raises:
            ValueError: as `load_config`.
            PermissionError: when it names anything in any section that is not trusted.
        """
        content = self._known_settings()
        require_trusted(content, trusted, self.path / CONFIG, trains=True)
        return OmegaConf.create(content)

    def _known_settings(self) -> dict[str, Any]:
        """Read the configuration of a run of this version as plain data."""
        path = self.path / CONFIG
        content = read_plain(path)
        if missing := [name for name in BUILT[:3] if name not in content]:
            raise ValueError(
                f"{path}: expected the sections {list(BUILT[:3])} of a training run, but {missing} "
                "are missing; give the folder that training printed when it ended"
            )
        if isinstance(content["flow"], dict) and "combine" in content["flow"]:
            raise ValueError(
                f"{path}: written by version 0.1, whose configurations have other names; evaluate "
                "the run with that version, or train it again"
            )
        return content

    def save_checkpoint(
        self, file_name: str = CHECKPOINT, /, **modules: nn.Module | torch.optim.Optimizer
    ) -> None:
        """Write the state dicts of modules and optimizers under their names.

        Raises:
            CheckpointError: when the file cannot be written.
        """
        state = {name: module.state_dict() for name, module in modules.items()}
        save_data(self.path / file_name, state, self.path)

    def load_checkpoint(self) -> dict[str, Any]:
        """Read the state dicts; tensors and plain containers only, so no code can run.

        Raises:
            ValueError: when there is none, or it is not a whole checkpoint.
        """
        path = self.path / self.checkpoint
        if not path.is_file():
            raise self._unusable("is not there")
        if not path.stat().st_size:
            raise self._unusable("is empty")
        # Not from the cause: PyTorch advises to load what it refused in a way that runs code.
        try:
            state = torch.load(path, weights_only=True, map_location="cpu")
        except pickle.UnpicklingError:
            raise self._unusable("holds something else than tensors and plain containers") from None
        except Exception:  # the readers of its formats fail in any way
            raise self._unusable("is cut short, or no checkpoint at all") from None
        if not isinstance(state, dict):
            raise self._unusable(f"holds a {type(state).__name__}")
        return state

    def restore(self, **modules: nn.Module) -> None:
        """Give modules the states that `save_checkpoint` wrote under their names.

        Raises:
            ValueError: when the checkpoint is unusable, or of modules of other names or sizes.
        """
        state = self.load_checkpoint()
        for name, module in modules.items():
            if name not in state:
                raise self._unusable(f"has no {name!r}, but {sorted(map(str, state))}")
            try:
                module.load_state_dict(state[name])
            except Exception as error:  # so does what is no state at all
                raise self._unusable(f"has another {name!r} than {CONFIG}", error) from error

    def _unusable(self, what: str, error: Exception | None = None) -> ValueError:
        reason = "" if error is None else f" ({type(error).__name__}: {error})"
        return ValueError(
            f"{self.path / self.checkpoint}: expected the checkpoint that training wrote beside "
            f"{CONFIG}, but it {what}{reason}; copy both anew from where the run was trained, or "
            "train again"
        )

    def new_file(self, name: str) -> Path:
        """Return a path that is not taken: the name, or with the next number before its suffix."""
        path, number = self.path / name, 1
        while path.exists():
            number += 1
            path = (self.path / name).with_stem(f"{Path(name).stem}-{number}")
        return path

    @contextmanager
    def naming_what_cannot_be_written(self) -> Iterator[None]:
        """Name the folder where a full or read-only disk ends a run, whichever file it was.

        Loggers write by threads and buffers of their own, whose errors name nothing.

        Raises:
            CheckpointError: in place of such an error, saying how to go on.
        """
        try:
            yield
        except CheckpointError:
            raise
        except OSError as error:
            if error.errno not in _OF_THE_DISK:
                raise
            failed = f"{self.path}: could not be written to ({error})"
            remedy = "room, or the folder writable, and"
            if not self.has_started:
                raise CheckpointError(
                    f"{failed}; the run has not begun. Make {remedy} begin it again"
                ) from error
            raise CheckpointError(
                f"{failed}; the states in it are whole. Make {remedy} go on with: "
                f"{self._resuming()}"
            ) from error

    def _resuming(self) -> str:
        return f"cnfp-train resume={shlex.quote(str(self.path))}"

    def how_to_resume(self, frames: int | None = None) -> str:
        """Return a sentence for whoever stopped the run.

        Args:
            frames: The steps at which it was saved; None when it was not.
        """
        how = "ended at once" if frames is None else f"stopped and saved at step {frames}"
        return f"{how}; go on with: {self._resuming()}"

    def remove_partial_files(self) -> None:
        """Remove what is left of files that a run was writing when it was killed."""
        for name in (CONFIG, CHECKPOINT, BEST, SUMMARY, FAILURE, f"{STATES}/*"):
            remove_partial_files(self.path / name)

    def save_failure(self, error: BaseException) -> None:
        """Write why the run failed, as far as that can be written."""
        with suppress(OSError):
            write_json(self.path / FAILURE, {"reason": f"{type(error).__name__}: {error}"})

    def load_failure(self) -> str | None:
        """Return why the run failed; None where it has not."""
        if not (self.path / FAILURE).is_file():
            return None
        return str(json.loads((self.path / FAILURE).read_text(encoding="utf-8"))["reason"])

    def forget_failure(self) -> None:
        """Remove what `save_failure` wrote, for a run that is tried again."""
        (self.path / FAILURE).unlink(missing_ok=True)

    def load_summary(self) -> dict[str, Any]:
        """Read the summary."""
        return dict(json.loads((self.path / SUMMARY).read_text(encoding="utf-8")))

    def save_summary(self, summary: dict[str, Any]) -> None:
        """Write the summary."""
        write_json(self.path / SUMMARY, summary)
