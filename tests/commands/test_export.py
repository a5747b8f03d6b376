"""``cnfp-export`` on a real run."""

import json
from pathlib import Path

import pytest

from cnfp_torchrl.commands.export import main
from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.train import train
from tests.training.conftest import TINY


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = RunFolder.create(tmp_path_factory.mktemp("run"))
    # One constraint, of which the exporters take half the time that they take of both.
    train(compose_config(*TINY, "~env.geometry.battery"), folder)
    return folder.path


def test_a_run_is_exported_and_tested(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main([str(run), "--to", "torch", "--steps", "0", "--states", "500", "--fallback", "0.5,-0.5"])
    printed = capsys.readouterr()
    assert "of 500 states" in printed.out
    assert ", 0 violations in them" in printed.out
    assert not printed.err
    manifest = json.loads((run / "export" / "manifest.json").read_text())
    assert manifest["checkpoint"] == "checkpoint.pt"
    assert manifest["fallback"] == [0.5, -0.5]
    assert manifest["self_test"]["states"] == 500
    assert manifest["self_test"]["violations"] == 0
    assert manifest["self_test"]["certified"] > 400
    assert set(manifest["milliseconds_for_one_state"]) == {"eager", "torch"}
    with pytest.raises(SystemExit, match="2"):
        main([str(run), "--to", "torch"])
    assert "nothing is overwritten" in capsys.readouterr().err


def test_refusals(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, words in (
        ([str(tmp_path / "nowhere")], "expected the folder of a finished run"),
        ([str(run), "--checkpoint", "best"], "checkpoint: expected checkpoint.pt, the last"),
        ([str(run), "--states", "0"], "--states: expected a number >= 1"),
        ([str(run), "--fallback", "a,b"], "--fallback: expected numbers separated by commas"),
        ([str(run), "--fallback", "7,7"], "within the action bounds"),
    ):
        with pytest.raises(SystemExit, match="2"):
            main([*arguments, "--to", "torch", "--output", str(tmp_path / "out")])
        assert words in capsys.readouterr().err
        assert not (tmp_path / "out").exists()
