"""The front page's picture."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from cnfp_torchrl.tasks.point_nav import PointNavEnv
from cnfp_torchrl.visual.figures.canvas import save_png
from experiments.figures.banner import flow_banner
from tests.pictures import is_a_picture
from tests.visual.cases import PLANE, first, make_snapshot

ROOT = Path(__file__).resolve().parents[2]


def test_banner(tmp_path: Path) -> None:
    snapshot = make_snapshot(first(PLANE, 2))
    snapshot.state["observation"] = torch.tensor([0.35, 0.0, 0.3, 0.5, 0.5])
    figure = flow_banner(snapshot, PointNavEnv(), counted=120_000)
    captions = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert captions[::2] == ["the state", "base", "action bounds", "battery", "obstacle"]
    assert captions[-1] == "0 of 120,000 actions break a rule"
    assert is_a_picture(save_png(figure, tmp_path / "banner.png", dpi=60))


def test_kept_banner_is_small() -> None:
    path = ROOT / "docs" / "images" / "flow.png"
    assert is_a_picture(path)
    assert path.stat().st_size < 250_000


@pytest.mark.slow
def test_banner_command(tmp_path: Path) -> None:
    path = tmp_path / "flow.png"
    command = [sys.executable, ROOT / "experiments" / "figures" / "banner.py", path]
    subprocess.run(command, check=True, cwd=tmp_path)
    with Image.open(path) as drawn, Image.open(ROOT / "docs" / "images" / "flow.png") as kept:
        assert drawn.size == kept.size
        difference = np.abs(np.asarray(drawn).astype(int) - np.asarray(kept).astype(int))
    # Not bit for bit: other processors round otherwise.
    assert difference.mean() < 1
