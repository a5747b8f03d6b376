"""Rerun as a logger of TorchRL: scalars, histograms, videos and hyperparameters."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import torch
from torch import Tensor
from torchrl.record.loggers import Logger

from cnfp_torchrl.visual.rerun.style import METRICS, TIMELINE

_FLUSH_S = 5.0


class RerunLogger(Logger):
    """Log to Rerun through TorchRL's interface, on the timeline ``env_step``.

    Values lie under ``metrics/NAME``; `flow_blueprint` plots them with ``training=TRAINING_PLOTS``.
    A number that is not finite is reported as a warning under ``metrics/warnings``, because Rerun
    would draw it as nothing.

    Args:
        exp_name: The name of the file, without its ending.
        log_dir: The folder of the file ``EXP_NAME.rrd``, made if it is missing.
        stream: An open stream to log to, so that no file is written; it is left open at the end.

    Raises:
        FileExistsError: when the file exists: nothing is overwritten.
        TypeError: when neither a folder nor a stream is given, or both.
    """

    def __init__(
        self,
        exp_name: str,
        log_dir: str | None = None,
        *,
        stream: rr.RecordingStream | None = None,
    ) -> None:
        if (log_dir is None) == (stream is None):
            raise TypeError(
                "RerunLogger: expected either log_dir, for a file of its own, or stream, given "
                f"log_dir={log_dir!r} and stream={stream!r}"
            )
        self._given = stream
        self._steps: dict[str, int] = {}
        self._path = None if log_dir is None else Path(log_dir) / f"{exp_name}.rrd"
        self._is_open = True
        super().__init__(exp_name, log_dir)

    def _create_experiment(self) -> rr.RecordingStream:
        if self._given is not None:
            return self._given
        assert self._path is not None
        if self._path.exists():
            raise FileExistsError(
                f"log_dir: expected a folder without {self._path.name}, given {self._path.parent}; "
                "nothing is overwritten, choose another folder or exp_name"
            )
        self._path.parent.mkdir(parents=True, exist_ok=True)
        stream = rr.RecordingStream("cnfp_torchrl", recording_id=self.exp_name)
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        stream.save(self._path)
        return stream

    def log_scalar(
        self, name: str, value: float | Tensor | Sequence[float], step: int | None = None
    ) -> None:
        """Log a number, or several of one name.

        Args:
            name: The name, in which slashes separate groups, as in ``loss/actor``.
            value: The number; what is not finite is not drawn, but reported.
            step: The step of the environment; None counts the calls with this name.
        """
        values = np.atleast_1d(np.asarray(torch.as_tensor(value).detach().cpu(), dtype=np.float64))
        self._set_step(name, step)
        if not np.isfinite(values).all():
            given = ", ".join(f"{number:g}" for number in values)
            self._log("warnings", rr.TextLog(f"{name} is {given}", level=rr.TextLogLevel.WARN))
            return
        self._log(name, rr.Scalars(values))

    def log_video(self, name: str, video: Tensor, step: int | None = None, **kwargs: Any) -> None:
        """Log the pictures of a video, on the timeline ``frame``.

        Args:
            name: The name of the video.
            video: The video, ``(videos, time, channels, height, width)`` or without the first,
                bytes; of several videos the first is taken.
            step: The step of the environment; None counts the calls with this name.
            kwargs: Options such as ``fps``, for other loggers; the viewer has its own speed.

        Raises:
            ValueError: for another shape.
        """
        clip = video[0] if video.ndim == 5 else video
        if clip.ndim != 4 or clip.shape[1] not in (1, 3, 4):
            raise ValueError(
                "video: expected (videos, time, channels, height, width) with 1, 3 or 4 channels, "
                f"given shape {tuple(video.shape)}"
            )
        self._set_step(name, step)
        for frame, picture in enumerate(clip.detach().cpu().to(torch.uint8).movedim(1, -1)):
            self.experiment.set_time("frame", sequence=frame)
            self._log(name, rr.Image(picture.numpy()))
        self.experiment.disable_timeline("frame")

    def log_hparams(self, cfg: Any) -> None:
        """Log hyperparameters as a text.

        Args:
            cfg: A mapping, such as a Hydra configuration.
        """
        text = json.dumps(_plain(cfg), indent=2, default=str)
        document = rr.TextDocument(f"```json\n{text}\n```", media_type="text/markdown")
        self._log("hyperparameters", document, static=True)

    def log_histogram(
        self, name: str, data: Sequence[float] | Tensor, step: int | None = None, **kwargs: Any
    ) -> None:
        """Log how often values occur.

        Args:
            name: The name of the histogram.
            data: The values, of any shape; those that are not finite are reported and left out.
            step: The step of the environment; None counts the calls with this name.
            kwargs: Options passed on to `numpy.histogram`, such as ``bins``.
        """
        values = np.asarray(torch.as_tensor(data).detach().cpu(), dtype=np.float64).reshape(-1)
        self._set_step(name, step)
        finite = values[np.isfinite(values)]
        if len(finite) < len(values):
            message = (
                f"{len(values) - len(finite)} of {len(values)} values of {name} are not finite"
            )
            self._log("warnings", rr.TextLog(message, level=rr.TextLogLevel.WARN))
        counts, edges = np.histogram(finite, **kwargs)
        middles = (edges[:-1] + edges[1:]) / 2
        self._log(name, rr.BarChart(counts, abscissa=middles))

    def flush(self, timeout: float | None = None) -> None:
        """Wait until what was logged has left this process, for a bounded time.

        Args:
            timeout: The longest wait in seconds; None waits for a few.
        """
        self.experiment.flush(timeout_sec=_FLUSH_S if timeout is None else timeout)

    def shutdown(self, timeout: float | None = None) -> None:
        """Finish the file; a stream that was given stays open."""
        if not self._is_open:
            return
        self.flush(timeout)
        if self._given is None:
            self.experiment.disconnect()
        self._is_open, self._service_shutdown = False, True

    def __repr__(self) -> str:
        where = "a stream" if self._path is None else str(self._path)
        return f"RerunLogger(exp_name={self.exp_name!r}, to={where})"

    def _set_step(self, name: str, step: int | None) -> None:
        if step is None:
            step = self._steps.get(name, -1) + 1
        self._steps[name] = int(step)
        # Streams of episodes count on timelines of their own.
        self.experiment.reset_time()
        self.experiment.set_time(TIMELINE, sequence=int(step))

    def _log(self, name: str, archetype: rr.AsComponents, *, static: bool = False) -> None:
        path = rr.new_entity_path([METRICS, *name.strip("/").split("/")])
        self.experiment.log(path, archetype, static=static)


def _plain(value: Any) -> Any:
    """Return mappings and lists of any kind as those of Python."""
    if isinstance(value, Mapping) or hasattr(value, "items"):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [_plain(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value
