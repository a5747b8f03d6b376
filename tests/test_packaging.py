"""The wheel is whole: it carries the configuration, and trains in any folder."""

import json
import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

import cnfp_torchrl
from cnfp_torchrl import configuration

ROOT = Path(__file__).resolve().parents[1]

# The shortest run of the main job that still passes through each of its phases.
TINY_RUN = [
    "collector.total_frames=256",
    "training.warmup_frames=128",
    "training.update_ratio=0.05",
    "training.log_interval=64",
    "evaluation.episodes=4",
]


def run(command: list[str | Path], cwd: Path) -> str:
    """Run a command without what this process's environment says of Python; return its output."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    done = subprocess.run(
        command,
        cwd=cwd,
        env=environment | {"OMP_NUM_THREADS": "1"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{command} exited {done.returncode}:\n{done.stdout}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    run([sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder], ROOT)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the `bin` folder of an environment that holds the wheel and sees our dependencies."""
    environment = tmp_path_factory.mktemp("environment")
    venv.create(environment, with_pip=False)
    python = environment / "bin" / "python"
    (site_packages,) = environment.glob("lib/python*/site-packages")
    # A folder named in a .pth file is searched, but its own .pth files are not read: the
    # dependencies are seen, the editable install of the checkout is not.
    (site_packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    pip = [sys.executable, "-m", "pip", "--python", python, "install"]
    # --ignore-installed: pip sees the editable install's metadata and would remove it.
    run([*pip, "--no-deps", "--no-index", "--ignore-installed", wheel], environment)
    return environment / "bin"


def test_checkout_finds_its_own_configuration() -> None:
    assert configuration.config_directory() == ROOT / "conf"


def test_missing_configuration_names_the_places(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="configuration files") as error:
        configuration.config_directory(tmp_path / "cnfp_torchrl")
    assert str(tmp_path / "cnfp_torchrl" / "conf") in str(error.value)
    assert str(tmp_path / "conf") in str(error.value)


def test_wheel_carries_every_configuration_file(wheel: Path) -> None:
    files = [path for path in (ROOT / "conf").rglob("*") if path.is_file()]
    assert files
    with zipfile.ZipFile(wheel) as archive:
        for path in files:
            packed = f"cnfp_torchrl/{path.relative_to(ROOT).as_posix()}"
            assert archive.read(packed) == path.read_bytes()


def test_wheel_carries_the_template_of_a_task(wheel: Path) -> None:
    template = ROOT / "cnfp_torchrl" / "commands" / "new_task"
    files = [path for path in template.iterdir() if path.is_file()]
    assert files
    with zipfile.ZipFile(wheel) as archive:
        for path in files:
            assert archive.read(path.relative_to(ROOT).as_posix()) == path.read_bytes()


def test_wheel_holds_the_package_alone(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    top = {name.split("/")[0] for name in names}
    assert top == {"cnfp_torchrl", f"cnfp_torchrl-{cnfp_torchrl.__version__}.dist-info"}
    assert "cnfp_torchrl/py.typed" in names


def test_installed_wheel_does_not_use_the_checkout(installed: Path, tmp_path: Path) -> None:
    code = (
        "import cnfp_torchrl, cnfp_torchrl.configuration as configuration\n"
        "print(cnfp_torchrl.__file__)\n"
        "print(configuration.config_directory())\n"
    )
    for line in run([installed / "python", "-I", "-c", code], tmp_path).splitlines():
        assert Path(line).is_relative_to(installed.parent), line


def test_installed_wheel_trains_in_any_folder(installed: Path, tmp_path: Path) -> None:
    run([installed / "cnfp-train", *TINY_RUN], tmp_path)
    (summary,) = tmp_path.rglob("summary.json")
    assert json.loads(summary.read_text())["steps"] > 0
