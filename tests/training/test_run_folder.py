import pickle
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from cnfp_torchrl.training.run_folder import CHECKPOINT, CONFIG, SUMMARY, RunFolder


class Payload:
    """What a stranger's checkpoint could carry: code that runs when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return Path.touch, (self.path,)


@pytest.mark.parametrize("held", [CONFIG, CHECKPOINT, SUMMARY])
def test_a_second_run_never_writes_over_the_first(held: str, tmp_path: Path) -> None:
    (tmp_path / held).write_text("the first run")
    with pytest.raises(FileExistsError, match=held):
        RunFolder.create(tmp_path)
    assert (tmp_path / held).read_text() == "the first run"


def test_an_unfinished_run_is_named(tmp_path: Path) -> None:
    (tmp_path / CONFIG).write_text("seed: 0")
    with pytest.raises(FileNotFoundError, match=CHECKPOINT):
        RunFolder.open(tmp_path)


def test_a_strangers_checkpoint_runs_no_code(tmp_path: Path) -> None:
    torch.save({"actor": Payload(tmp_path / "owned")}, tmp_path / CHECKPOINT)
    with pytest.raises(pickle.UnpicklingError):
        RunFolder(tmp_path).load_checkpoint()
    assert not (tmp_path / "owned").exists()


SECTIONS = {"env": {}, "flow": {}, "network": {}}


@pytest.mark.parametrize("section", SECTIONS)
@pytest.mark.parametrize(
    "content",
    [
        {"_target_": "os.system", "command": "true"},
        {"deep": [{"_target_": "torch.load", "f": "stranger.pt"}]},
        {"_target_": "cnfp_torchrl_evil.run"},
        {"_target_": "${oc.env:HOME}"},
        {"_target_": "hydra.utils.get_method", "path": "os.system"},
    ],
)
def test_a_strangers_configuration_instantiates_nothing_foreign(
    section: str, content: dict[str, object], tmp_path: Path
) -> None:
    OmegaConf.save(SECTIONS | {section: content}, tmp_path / CONFIG)
    with pytest.raises(PermissionError, match=section):
        RunFolder(tmp_path).load_config()


def test_own_packages_can_be_trusted(tmp_path: Path) -> None:
    content = SECTIONS | {"env": {"_target_": "my_package.Env"}}
    OmegaConf.save(content, tmp_path / CONFIG)
    with pytest.raises(PermissionError, match=r"my_package\.Env"):
        RunFolder(tmp_path).load_config()
    assert RunFolder(tmp_path).load_config(["my_package."]) == content
