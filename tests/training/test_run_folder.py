import errno
import io
import json
import os
import pickle
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch
from matplotlib.figure import Figure
from omegaconf import DictConfig, OmegaConf
from torch import nn

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.training.agent import build_actor, build_environment, load_actor
from cnfp_torchrl.training.checkpoints import CheckpointError
from cnfp_torchrl.training.run_folder import BEST, CHECKPOINT, CONFIG, SUMMARY, RunFolder
from cnfp_torchrl.visual.figures.canvas import save_png
from cnfp_torchrl.whole_file import whole_file
from tests.payload import Payload


@pytest.mark.parametrize("held", [CONFIG, CHECKPOINT, SUMMARY])
def test_a_second_run_never_writes_over_the_first(held: str, tmp_path: Path) -> None:
    (tmp_path / held).write_text("the first run")
    with pytest.raises(FileExistsError, match=held):
        RunFolder.create(tmp_path)
    assert (tmp_path / held).read_text() == "the first run"


def test_two_runs_at_once_never_share_a_folder(tmp_path: Path) -> None:
    first = RunFolder.create(tmp_path / "run")
    with pytest.raises(FileExistsError, match=r"another run works in .*hydra\.run\.dir"):
        RunFolder.create(tmp_path / "run")
    assert not list(first.path.iterdir())
    first.close()
    second = RunFolder.create(tmp_path / "run")
    path = second.path
    del second
    assert RunFolder.create(path)


def test_where_folders_cannot_be_locked_the_first_configuration_decides(tmp_path: Path) -> None:
    first, second = RunFolder(tmp_path), RunFolder(tmp_path)
    first.save_config(DictConfig({"seed": 1}))
    with pytest.raises(FileExistsError, match=CONFIG):
        second.save_config(DictConfig({"seed": 2}))
    assert first.load_settings() == {"seed": 1}
    assert [path.name for path in tmp_path.iterdir()] == [CONFIG]


def test_a_command_leaves_the_folder_of_a_running_run_as_it_is(tmp_path: Path) -> None:
    first = RunFolder.create(tmp_path / "run")
    (first.path / ".hydra").mkdir()
    (first.path / ".hydra" / "overrides.yaml").write_text("- of the first")
    done = subprocess.run(
        [Path(sys.executable).parent / "cnfp-train", f"hydra.run.dir={first.path}", "seed=3"],
        cwd=tmp_path,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode != 0
    assert f"another run works in {first.path}" in done.stderr
    left = {path.name for path in first.path.rglob("*") if path.is_file() and path.stat().st_size}
    assert left == {"overrides.yaml"}
    assert (first.path / ".hydra" / "overrides.yaml").read_text() == "- of the first"


def test_an_unfinished_run_is_named(tmp_path: Path) -> None:
    (tmp_path / CONFIG).write_text("seed: 0")
    with pytest.raises(FileNotFoundError, match=CHECKPOINT):
        RunFolder.open(tmp_path)


@pytest.mark.parametrize("name", ["best", "last", "checkpoints/state-1.pt", ""])
def test_a_checkpoint_of_another_name_is_refused_with_those_that_there_are(
    name: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=f"^checkpoint: expected {CHECKPOINT}.*{BEST}"):
        RunFolder.open(tmp_path, name)


def test_a_run_that_was_stopped_without_a_best_policy_is_to_be_finished(tmp_path: Path) -> None:
    (tmp_path / CONFIG).touch()
    with pytest.raises(
        FileNotFoundError, match=f"finish the run with cnfp-train resume={tmp_path}"
    ):
        RunFolder.open(tmp_path, BEST)


def test_a_finished_run_without_a_best_policy_is_not_to_be_trained_again(tmp_path: Path) -> None:
    for name in (CONFIG, CHECKPOINT):
        (tmp_path / name).touch()
    with pytest.raises(FileNotFoundError, match=f"^checkpoint: expected {BEST}.*{CHECKPOINT}$"):
        RunFolder.open(tmp_path, BEST)


@contextmanager
def full_disk(size: int) -> Iterator[None]:
    """Let no file of this process grow beyond a size, as on a disk with as much space left."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


LARGE = nn.Linear(100, 100)
WRITERS: dict[str, Callable[[Path], Any]] = {
    CHECKPOINT: lambda path: RunFolder(path.parent).save_checkpoint(actor=LARGE),
    CONFIG: lambda path: RunFolder(path.parent).save_config(DictConfig({"a": "x" * 5000})),
    SUMMARY: lambda path: RunFolder(path.parent).save_summary({"a": "x" * 5000}),
    "figure.png": lambda path: save_png(Figure(), path),
}


@pytest.mark.parametrize("name", WRITERS)
def test_on_a_full_disk_nothing_is_left(name: str, tmp_path: Path) -> None:
    with full_disk(1000), pytest.raises((OSError, RuntimeError)):
        WRITERS[name](tmp_path / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("exclusive", [False, True])
def test_an_interrupted_file_leaves_what_was_there(exclusive: bool, tmp_path: Path) -> None:
    path = tmp_path / "file"

    def write(content: bytes) -> None:
        with whole_file(path, exclusive=exclusive) as file:
            file.write(content)
            if content == b"half":
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(b"half")
    assert not list(tmp_path.iterdir())
    write(b"whole")
    with pytest.raises(KeyboardInterrupt):
        write(b"half")
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"whole"]
    assert path.stat().st_mode & 0o777 == 0o666 & ~_umask()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def saved(content: object) -> bytes:
    buffer = io.BytesIO()
    torch.save(content, buffer)
    return buffer.getvalue()


@pytest.fixture
def whole(tmp_path: Path) -> RunFolder:
    """A run's folder with an untrained actor."""
    config = compose_config()
    folder = RunFolder.create(tmp_path / "run")
    folder.save_config(config)
    folder.save_checkpoint(actor=build_actor(config, build_environment(config)))
    return folder


def load(folder: RunFolder) -> None:
    config = folder.load_config()
    load_actor(folder, config, build_environment(config))


BROKEN: dict[str, Callable[[bytes], bytes | None]] = {
    "none": lambda _: None,
    "empty": lambda _: b"",
    "one byte": lambda whole: whole[:1],
    "half": lambda whole: whole[: len(whole) // 2],
    "all but the end": lambda whole: whole[:-30],
    "a hole": lambda whole: whole[:400] + bytes(400) + whole[800:],
    "text": lambda _: b"a checkpoint\n",
    "JSON": lambda _: json.dumps({"actor": {}}).encode(),
    "zeros": lambda whole: bytes(len(whole)),
    "random": lambda _: torch.randint(256, (5000,), dtype=torch.uint8).numpy().tobytes(),
    "a pickle": lambda _: pickle.dumps({"actor": {}}),
    "a list": lambda _: saved([1]),
    "a number": lambda _: saved(1),
    "another name": lambda _: saved({"critic": {}}),
    "no state": lambda _: saved({"actor": 3}),
    "a state of numbers": lambda _: saved({"actor": {"a": 1}}),
    "other keys": lambda _: saved({"actor": nn.Linear(2, 2).state_dict()}),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_checkpoint_is_refused_by_a_sentence(kind: str, whole: RunFolder) -> None:
    load(whole)
    path = whole.path / CHECKPOINT
    content = BROKEN[kind](path.read_bytes())
    path.unlink()
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ValueError, match="train again") as caught:
        load(whole)
    assert str(path) in str(caught.value)
    assert "weights_only" not in str(caught.value)


def test_a_checkpoint_of_other_sizes_is_refused(whole: RunFolder) -> None:
    config = compose_config("network.hidden=[8]")
    whole.save_checkpoint(actor=build_actor(config, build_environment(config)))
    with pytest.raises(ValueError, match=r"(?s)checkpoint\.pt: .*has another 'actor'.*size"):
        load(whole)


def test_a_strangers_checkpoint_runs_no_code(whole: RunFolder, tmp_path: Path) -> None:
    torch.save({"actor": Payload(tmp_path / "owned")}, whole.path / CHECKPOINT)
    with pytest.raises(ValueError, match="something else than tensors"):
        load(whole)
    assert not (tmp_path / "owned").exists()


SECTIONS: dict[str, Any] = {"env": {}, "flow": {}, "network": {}}


def test_own_packages_can_be_trusted(tmp_path: Path) -> None:
    content = SECTIONS | {"env": {"_target_": "my_package.Env"}}
    OmegaConf.save(content, tmp_path / CONFIG)
    with pytest.raises(PermissionError, match=r"my_package\.Env"):
        RunFolder(tmp_path).load_config()
    assert RunFolder(tmp_path).load_config(["my_package."]) == content


def test_sections_of_training_alone_are_data(tmp_path: Path) -> None:
    own = {"seed": 3, "optim": {"_target_": "my_package.Optimizer", "lr": 0.1}}
    OmegaConf.save(SECTIONS | own, tmp_path / CONFIG)
    assert RunFolder(tmp_path).load_config() == SECTIONS | {"seed": 3}
    assert RunFolder(tmp_path).load_settings() == SECTIONS | own


@pytest.mark.parametrize("missing", SECTIONS)
def test_missing_sections_are_named(missing: str, tmp_path: Path) -> None:
    OmegaConf.save({k: v for k, v in SECTIONS.items() if k != missing}, tmp_path / CONFIG)
    with pytest.raises(ValueError, match=missing):
        RunFolder(tmp_path).load_config()


OLD: dict[str, Any] = {
    "env": {"layout": {"_target_": "cnfp_torchrl.envs.Layout"}},
    "flow": {"order": ["a"], "combine": {"_target_": "cnfp_torchrl.modules.ExactFlow"}},
    "network": {},
}


@pytest.mark.parametrize("trusted", [(), ("",)])
def test_a_run_of_version_0_1_is_refused_as_such(trusted: tuple[str, ...], tmp_path: Path) -> None:
    OmegaConf.save(OLD, tmp_path / CONFIG)
    with pytest.raises(ValueError, match=r"config\.yaml: .*version 0\.1.*train"):
        RunFolder(tmp_path).load_config(trusted)
    assert RunFolder(tmp_path).load_settings() == OLD


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS])
def test_a_disk_that_ends_a_run_is_told_with_the_folder(number: int, tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "my run")
    with (
        pytest.raises(CheckpointError, match=r"my run: could not .*the run has not begun"),
        folder.naming_what_cannot_be_written(),
    ):
        raise OSError(number, os.strerror(number))
    (folder.path / "config.yaml").touch()
    with (
        pytest.raises(CheckpointError, match=r"my run: could not .*resume='.*my run'"),
        folder.naming_what_cannot_be_written(),
    ):
        raise OSError(number, os.strerror(number))  # as loggers do, without a file's name
    refused = OSError(errno.ECONNREFUSED, os.strerror(errno.ECONNREFUSED))
    with pytest.raises(ConnectionRefusedError), folder.naming_what_cannot_be_written():
        raise refused
