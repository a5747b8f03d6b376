"""The front page's picture."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from cnfp_torchrl.tasks.point_nav import Layout
from cnfp_torchrl.visual import banner
from tests.visual.cases import PLANE, first, make_snapshot
from tests.visual.conftest import is_a_picture

ROOT = Path(__file__).resolve().parents[2]


def test_banner(monkeypatch: pytest.MonkeyPatch, draws: Callable[[Figure], bool]) -> None:
    monkeypatch.setattr(banner, "_COUNTED", 100_000)
    snapshot = make_snapshot(first(PLANE, 2))
    snapshot.state["observation"] = torch.tensor([0.35, 0.0, 0.3, 0.5, 0.5])
    figure = banner.flow_banner(snapshot, Layout())
    words = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert words[::2] == ["the state", "base", "action bounds", "battery", "obstacle"]
    assert words[-1] == "0 of 100,000 actions break a rule"
    assert draws(figure)


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
