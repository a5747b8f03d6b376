"""Rerun as a logger of TorchRL."""

from pathlib import Path

import numpy as np
import pytest
import rerun as rr
import torch
from omegaconf import OmegaConf

from cnfp_torchrl.visual.rerun import RerunLogger
from tests.visual.rerun.recorded import read, recorded


def test_scalars_are_in_the_file(tmp_path: Path) -> None:
    logger = RerunLogger("run", str(tmp_path / "new"))
    logger.log_scalar("loss/actor", 0.5, step=10)
    logger.log_scalar("loss/actor", torch.tensor(0.25, requires_grad=True), step=20)
    logger.log_metrics({"train/return": torch.tensor([1.0, 2.0])}, step=20)
    logger.log_scalar("counted", 1.0)
    logger.log_scalar("counted", 2.0)
    logger.shutdown()
    logger.shutdown()
    path = tmp_path / "new" / "run.rrd"

    def scalars(name: str) -> dict[int, list[float]]:
        logged = read(path, f"/metrics/{name}", "Scalars:scalars")
        return {step: values.tolist() for step, values in logged.items()}

    assert scalars("loss/actor") == {10: [0.5], 20: [0.25]}
    assert scalars("train/return") == {20: [1.0, 2.0]}
    assert scalars("counted") == {0: [1.0], 1: [2.0]}


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_would_not_be_drawn_is_reported(value: float, tmp_path: Path) -> None:
    logger = RerunLogger("run", str(tmp_path))
    logger.log_scalar("loss/actor", value, step=3)
    logger.shutdown()
    path = tmp_path / "run.rrd"
    assert not read(path, "/metrics/loss/actor", "Scalars:scalars")
    assert read(path, "/metrics/warnings", "TextLog:text")[3].tolist() == [
        f"loss/actor is {value:g}"
    ]


def test_histograms_count(tmp_path: Path) -> None:
    logger = RerunLogger("run", str(tmp_path))
    data = torch.tensor([0.1, 0.2, 0.9, torch.nan])
    logger.log_histogram("actions", data, step=1, bins=2, range=(0, 1))
    logger.shutdown()
    path = tmp_path / "run.rrd"
    (counts,) = read(path, "/metrics/actions", "BarChart:values")[1]
    assert list(counts["buffer"]) if isinstance(counts, dict) else counts is not None
    (warning,) = read(path, "/metrics/warnings", "TextLog:text")[1]
    assert warning == "1 of 4 values of actions are not finite"


@pytest.mark.parametrize("videos", [(), (1,)], ids=["one", "batch of one"])
def test_videos_are_pictures_in_time(videos: tuple[int, ...], tmp_path: Path) -> None:
    video = torch.arange(2 * 3 * 4 * 5, dtype=torch.uint8).reshape(*videos, 2, 3, 4, 5)
    logger = RerunLogger("run", str(tmp_path))
    logger.log_video("episode", video, step=7, fps=6)
    logger.log_scalar("after", 1.0, step=8)
    logger.shutdown()
    path = tmp_path / "run.rrd"
    # Both pictures carry the same step; the later one is the second.
    last = read(path, "/metrics/episode", "Image:buffer")[7].reshape(4, 5, 3)
    np.testing.assert_array_equal(last, video.reshape(2, 3, 4, 5)[1].movedim(0, -1).numpy())


def test_video_of_another_shape_is_refused(tmp_path: Path) -> None:
    logger = RerunLogger("run", str(tmp_path))
    with pytest.raises(ValueError, match=r"1, 3 or 4 channels, given shape \(2, 5, 4, 4\)"):
        logger.log_video("episode", torch.zeros(2, 5, 4, 4))
    logger.shutdown()


@pytest.mark.parametrize("make", [dict, OmegaConf.create], ids=["dict", "omegaconf"])
def test_hyperparameters_are_a_text(make: type, tmp_path: Path) -> None:
    logger = RerunLogger("run", str(tmp_path))
    logger.log_hparams(make({"optim": {"lr": 3e-4}, "order": ["battery", "obstacle"]}))
    logger.shutdown()
    (text,) = read(tmp_path / "run.rrd", "/metrics/hyperparameters", "TextDocument:text")[-1]
    assert '"lr": 0.0003' in text
    assert '"battery"' in text


def test_given_stream_stays_open(tmp_path: Path) -> None:
    path = tmp_path / "recording.rrd"
    with recorded(path) as stream:
        logger = RerunLogger("run", stream=stream)
        logger.log_scalar("one", 1.0, step=0)
        logger.shutdown()
        stream.log("later", rr.Scalars(2.0))
    assert read(path, "/later", "Scalars:scalars")[0].tolist() == [2.0]


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    RerunLogger("run", str(tmp_path)).shutdown()
    before = (tmp_path / "run.rrd").read_bytes()
    with pytest.raises(FileExistsError, match=r"a folder without run\.rrd"):
        RerunLogger("run", str(tmp_path))
    assert (tmp_path / "run.rrd").read_bytes() == before


def test_neither_folder_nor_stream_is_refused() -> None:
    with pytest.raises(TypeError, match="either log_dir, for a file of its own, or stream"):
        RerunLogger("run")
