from importlib.util import find_spec
from pathlib import Path

import pytest

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.training.loggers import WANDB_ID
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.train import train

from .conftest import TINY


@pytest.mark.skipif(find_spec("wandb") is None, reason="the extra wandb is not installed")
def test_weights_and_biases_gets_a_run_and_what_comes_after_it_as_one(tmp_path: Path) -> None:
    options = ["logger=wandb", "logger.wandb.offline=true"]
    folder = RunFolder.create(tmp_path / "run")
    train(compose_config(*TINY, *options), folder)
    longer = compose_config(*TINY, *options, "collector.total_frames=256")
    train(longer, RunFolder.resume(folder.path), resume=True)
    name = (folder.path / WANDB_ID).read_text()
    files = list(folder.path.glob("wandb/offline-run-*/*.wandb"))
    assert [file.name for file in files] == [f"run-{name}.wandb"] * 2
    assert all(b"violations/obstacle" in file.read_bytes() for file in files)
