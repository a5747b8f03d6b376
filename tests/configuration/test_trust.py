"""What a stranger's configuration may name, against everything that a dotted name can reach."""

import inspect
import re
import sys
import warnings
from collections.abc import Iterator
from functools import partial
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
import yaml
from hydra.utils import instantiate
from omegaconf import OmegaConf

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.configuration.trust import (
    BUILT,
    FOREIGN,
    nameable,
    read_plain,
    require_trusted,
    targets,
)
from cnfp_torchrl.training.agent import build_actor, build_environment
from cnfp_torchrl.training.run_folder import CONFIG, RunFolder
from tests.entry_points import call_command
from tests.payload import Payload

PATH = Path("run/config.yaml")
CALL = "cnfp_torchrl.training.run_folder.torch.load"


def members(owner: Any) -> Iterator[tuple[str, Any]]:
    for name in dir(owner):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                yield name, getattr(owner, name)
            except Exception:
                continue


def paths(module: str, depth: int, seen: set[int] | None = None) -> Iterator[tuple[str, Any]]:
    """Yield every attribute path out of a module, but none behind other objects that were seen."""
    reached: list[tuple[str, Any]] = [(module, import_module(module))]
    seen = set() if seen is None else seen
    seen.discard(id(reached[0][1]))
    for _ in range(depth):
        further = []
        for path, owner in reached:
            if id(owner) in seen or not isinstance(owner, ModuleType | type | partial):
                continue
            seen.add(id(owner))
            for name, member in members(owner):
                yield f"{path}.{name}", member
                further.append((f"{path}.{name}", member))
        reached = further


def refusal(content: Any, *trusted: str) -> str | None:
    try:
        require_trusted(content, trusted, PATH)
    except PermissionError as error:
        return str(error)
    return None


MODULES = sorted({name.rpartition(".")[0] for name in nameable() if name.startswith("cnfp_")})


def test_no_path_leads_out_of_the_modules_of_targets() -> None:
    # Most modules lead to PyTorch, which is searched from the first one that does.
    seen: set[int] = set()
    tried = 0
    for module in MODULES:
        accepted = 0
        for path, found in paths(module, 3, seen):
            tried += 1
            said = refusal({"env": {"base": {"_target_": path}}})
            if said is None:
                accepted += 1
                assert path in nameable()
                assert found.__module__.startswith("cnfp_torchrl.")
            else:
                assert repr(path) in said
        assert accepted, module
    assert tried > 10_000


def test_what_may_be_named_is_defined_here_or_listed() -> None:
    homes = {name for name in nameable() if not name.startswith("cnfp_torchrl.")}
    assert set(FOREIGN) <= homes
    assert {name.rpartition(".")[2] for name in homes} == {"GymEnv"}
    for name in nameable() - homes:
        module, _, attribute = name.rpartition(".")
        found = getattr(import_module(module), attribute)
        assert found.__module__.startswith("cnfp_torchrl.")
        assert inspect.isclass(found) or inspect.isfunction(found)


@pytest.mark.parametrize("name", ["cnfp_torchrl.objectives.FusedAdam", "torch.optim.Adam"])
def test_runs_go_on_with_the_optimizers_of_now_and_before(name: str) -> None:
    content = {"optim": {"_target_": name, "lr": 1e-3, "fused": True}}
    require_trusted(content, [], PATH, trains=True)
    elsewhere = {"env": content["optim"]}
    if name.startswith("torch."):
        with pytest.raises(PermissionError, match=name):
            require_trusted(elsewhere, [], PATH, trains=True)


def test_what_may_be_named_takes_no_file() -> None:
    """Holds the list against new targets: their arguments are checked to be no paths as texts."""
    for name in nameable():
        module, _, attribute = name.rpartition(".")
        found = getattr(import_module(module), attribute)
        is_error = inspect.isclass(found) and issubclass(found, Exception)
        if is_error or name.startswith("torchrl."):
            continue  # GymEnv passes any keyword on: see `REFUSED`
        for parameter in inspect.signature(found).parameters.values():
            assert "Path" not in str(parameter.annotation), f"{name}({parameter})"


OWN = """
import functools
import os, subprocess
from pathlib import Path
import numpy as np
import torch
from os import system
from torch import load
from torchrl.envs import GymEnv
from cnfp_torchrl.tasks.point_nav import Layout as Map
from cnfp_torchrl.tasks.point_nav import PointNavEnv

class Env:
    @classmethod
    def make(cls): ...

class OwnPath(Path): ...

def make_env(batch_size): ...

make_other = functools.partial(make_env, [3])

@functools.lru_cache
def make_cached(): ...
"""
OWN_NAMES = {
    *("Env", "Env.make", "OwnPath", "make_env", "make_other", "make_other.func", "make_cached"),
    *("GymEnv", "PointNavEnv", "Map"),
}


@pytest.fixture
def own_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "own_pkg").mkdir()
    (tmp_path / "own_pkg" / "__init__.py").write_text("from own_pkg.envs import Env\n")
    (tmp_path / "own_pkg" / "envs.py").write_text(OWN)
    yield "own_pkg.envs"
    for name in [module for module in sys.modules if module.startswith("own_pkg")]:
        del sys.modules[name]


@pytest.mark.parametrize("trusted", ["own_pkg.", "own_pkg.envs"])
def test_trust_ends_where_the_trusted_package_ends(trusted: str, own_package: str) -> None:
    accepted = set()
    for path, _ in paths(own_package, 3):
        if refusal({"_target_": path}, trusted) is None:
            accepted.add(path.removeprefix(f"{own_package}."))
    assert accepted == OWN_NAMES


def test_trust_reaches_no_further_than_its_name(own_package: str) -> None:
    assert refusal({"_target_": "own_pkg.Env"}, "own_pkg.") is None
    assert refusal({"_target_": "own_pkg.Env"}, "own_pkg.Env") is None
    assert refusal({"_target_": "own_pkg.envs.np.load"}, "own_pkg.envs.np.load") is None
    assert refusal({"_target_": "own_pkg.envs.np.load"}, "") is None
    require_trusted({"_target_": "own_pkg.Env"}, "own_pkg.", PATH)  # no list of its letters
    assert refusal({"_target_": "own_pkg_evil.Env"}, "own_pkg")
    assert refusal({"_target_": "own_pkg.Env"}, "own_pkg.envs.")
    assert refusal({"_target_": "own_pkg.Env"})
    assert "own_pkg_evil" not in sys.modules


def test_nothing_untrusted_is_imported(own_package: str) -> None:
    del own_package
    assert "'own_pkg.envs.Env'" in str(refusal({"_target_": "own_pkg.envs.Env"}, "other."))
    assert "own_pkg" not in sys.modules


def test_arguments_of_trusted_targets_are_the_readers_own(own_package: str) -> None:
    target = {"_target_": f"{own_package}.make_env", "file": "/a/b.pt", "_own": "m:X"}
    assert refusal(target, "own_pkg.") is None
    inner = {"_target_": f"{own_package}.make_env", "inner": [{"_target_": CALL, "f": "x"}]}
    assert "inner[0]._target_: expected a target" in str(refusal(inner, "own_pkg."))
    gym = {"_target_": f"{own_package}.GymEnv", "env_name": "evil:X"}
    assert "env_name" in str(refusal(gym, "own_pkg."))


GYM = {"_target_": "torchrl.envs.GymEnv"}
HERE = {"_target_": "cnfp_torchrl.tasks.point_nav.Layout"}
REFUSED: dict[str, tuple[Any, str]] = {
    "a foreign function": ({"_target_": "os.system", "command": "true"}, "os.system"),
    "an attribute hop": ({"_target_": CALL, "f": "evil.pt", "weights_only": False}, CALL),
    "a function of ours that acts": (
        {"_target_": "cnfp_torchrl.visual.figures.draw_run_figures"},
        "draw",
    ),
    "our own reader": ({"_target_": "cnfp_torchrl.training.run_folder.RunFolder"}, "RunFolder"),
    "a method": ({"_target_": "cnfp_torchrl.tasks.point_nav.PointNavEnv.rollout"}, "rollout"),
    "a similar name": ({"_target_": "cnfp_torchrl_evil.run"}, "cnfp_torchrl_evil"),
    "in a list": ({"deep": [{"x": [{"_target_": "torch.load"}]}]}, r"deep\[0\].x\[0\]._target_"),
    "as an argument": (HERE | {"rectangles": {"_target_": "os.system"}}, "rectangles._target_"),
    "as a positional argument": (HERE | {"_args_": [{"_target_": "os.system"}]}, r"_args_\[0\]"),
    "not to be made now": (HERE | {"_recursive_": False, "a": {"_target_": "x.y"}}, "a._target_"),
    "no name": ({"_target_": ["os.system"]}, "_target_"),
    "null": ({"_target_": None}, "None"),
    "a target in a target": ({"_target_": {"_target_": "os.system"}}, "_target_"),
    "an empty name": ({"_target_": ""}, "_target_"),
    "a relative name": ({"_target_": ".envs.PointNavEnv"}, "_target_"),
    "an interpolation": ({"x": "${oc.env:HOME}"}, "interpolation"),
    "an interpolated target": ({"_target_": "${oc.env:HOME}"}, "_target_"),
    "an interpolated key": ({"${x}": 1}, "interpolation"),
    "an unknown special key": (HERE | {"_call_": 1}, "_call_"),
    "a private argument": (HERE | {"_x": 1}, "_x"),
    "a special key alone": ({"_unknown_": 1}, "_unknown_"),
    "_partial_ of a text": (HERE | {"_partial_": "yes"}, "_partial_"),
    "_convert_ to anything": (HERE | {"_convert_": "object2"}, "_convert_"),
    "_args_ of a text": (GYM | {"_args_": "evil:X"}, "_args_"),
    "_recursive_ of a number": (HERE | {"_recursive_": 0}, "_recursive_"),
    "an environment of a module": (GYM | {"env_name": "evil:X-v0"}, "env_name"),
    "the same by position": (GYM | {"_args_": ["evil:X-v0"]}, "_args_"),
    "the same in a list": (GYM | {"env_name": ["evil:X-v0"]}, "env_name"),
    "the same for a wrapper": (GYM | {"env_name": "GymV26-v0", "env_id": "m:X"}, "env_id"),
    "a library by name": (GYM | {"env_name": "Pendulum-v1", "backend": "evil"}, "backend"),
    "a path": (GYM | {"env_name": "Ant-v5", "xml_file": "/home/me/evil.xml"}, "xml_file"),
    "a file": (GYM | {"env_name": "Ant-v5", "xml_file": "evil.xml"}, "xml_file"),
    "a path in a mapping": (HERE | {"x": {"deep": ["../x"]}}, "deep"),
    "a relative path": (HERE | {"name": "a/b"}, "name"),
}  # fmt: skip


@pytest.mark.parametrize("section", BUILT)
@pytest.mark.parametrize("kind", REFUSED)
def test_a_strangers_configuration_is_refused(section: str, kind: str, tmp_path: Path) -> None:
    content, where = REFUSED[kind]
    sections: dict[str, Any] = {key: {} for key in BUILT} | {section: {"some": content}}
    (tmp_path / CONFIG).write_text(yaml.safe_dump(sections))
    with pytest.raises(PermissionError, match=where) as caught:
        RunFolder(tmp_path).load_config()
    said = str(caught.value)
    assert str(tmp_path / CONFIG) in said
    assert f"{section}.some" in said
    assert "trusted=[" in said


@pytest.mark.parametrize("kind", REFUSED)
def test_a_strangers_run_is_not_trained_further(kind: str, tmp_path: Path) -> None:
    content, where = REFUSED[kind]
    sections: dict[str, Any] = {key: {} for key in BUILT} | {"optim": {"some": content}}
    (tmp_path / CONFIG).write_text(yaml.safe_dump(sections))
    with pytest.raises(PermissionError, match=where):
        RunFolder(tmp_path).load_training_config()


@pytest.mark.parametrize(
    "choice", ["logger=wandb", "visual=connect", "visual=serve", "algorithm=ppo"]
)
def test_whatever_is_shipped_can_be_trained_further(choice: str, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    folder.save_config(compose_config(choice))
    assert folder.load_training_config() == folder.load_settings()


@pytest.mark.parametrize(
    "text",
    [
        "env: !!python/object/apply:os.system [true]",
        "env: !!python/object/apply:pathlib.PosixPath [x]",
        "env: !!python/name:os.system",
        "env: !own x",
        "env: !!str x",
        "env: &a {b: 1}\nflow: *a",
        "- env",
        "env",
        "",
        "env: {",
        "env: 1\nenv: 2",
        "env: " + "[" * 400 + "]" * 400,
        "env: 0b_",
        "\x00",
    ],
)
def test_only_plain_yaml_is_read(text: str, tmp_path: Path) -> None:
    (tmp_path / CONFIG).write_text(text)
    with pytest.raises(ValueError, match=re.escape(str(tmp_path / CONFIG))):
        RunFolder(tmp_path).load_config()


def test_plain_data_is_what_was_written(tmp_path: Path) -> None:
    config = {"a": 1e-5, "b": "1e-5", "c": [None, True, "0b1"], "d": {"e": -3, "f": "x: y"}}
    OmegaConf.save(OmegaConf.create(config), tmp_path / CONFIG)
    assert read_plain(tmp_path / CONFIG) == config


@pytest.mark.parametrize(
    "content",
    [
        GYM | {"env_name": "Pendulum-v1", "device": "cuda:0", "backend": "gymnasium", "g": 9.8},
        GYM | {"env_name": "ALE/Pong-v5", "render_mode": "rgb_array"},
        GYM | {"_args_": ["cnfp_torchrl/PointNav-v0"], "_convert_": "all"},
        GYM | {"env_name": "FrozenLake-v1", "map_name": "8x8", "is_slippery": False},
        {"_target_": "cnfp_torchrl.training.evaluation.StandStill", "_partial_": True},
        {"_target_": "cnfp_torchrl.modules.SafeRandomPolicy", "_partial_": True},
    ],
)
def test_what_is_harmless_is_accepted(content: dict[str, Any]) -> None:
    assert refusal({"env": content}) is None


EXPERIMENTS = sorted(
    path.stem for path in (Path(__file__).parents[2] / "conf" / "experiment").glob("*.yaml")
)


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_is_read_back(experiment: str, tmp_path: Path) -> None:
    config = compose_config(f"experiment={experiment}")
    folder = RunFolder(tmp_path)
    folder.save_config(config)
    assert folder.load_settings() == OmegaConf.to_container(config, resolve=True)
    read = folder.load_config()
    for section in BUILT:
        assert read[section] == folder.load_settings()[section]
    assert set(targets(OmegaConf.to_container(read))) <= nameable()
    assert folder.load_training_config() == folder.load_settings()
    assert instantiate(read.env.base, _convert_="all")


COMMANDS = {
    "cnfp-evaluate": ["run={run}", "evaluation.episodes=2", "hydra.run.dir={place}"],
    "cnfp-audit": ["run={run}", "batch=2", "hydra.run.dir={place}"],
    "cnfp-explain": ["{run}", "--step", "0"],
}


@pytest.fixture
def evil_run(tmp_path: Path) -> Path:
    """A whole run whose environment is a file that runs code when it is loaded."""
    config = compose_config()
    folder = RunFolder.create(tmp_path / "run")
    folder.save_config(config)
    folder.save_checkpoint(actor=build_actor(config, build_environment(config)))
    torch.save(Payload(tmp_path / "owned"), tmp_path / "evil.pt")
    content = yaml.safe_load((folder.path / CONFIG).read_text())
    content["env"]["base"] = {
        "_target_": CALL,
        "f": str(tmp_path / "evil.pt"),
        "weights_only": False,
    }
    (folder.path / CONFIG).write_text(yaml.safe_dump(content))
    return folder.path


def test_the_evil_file_would_run_code(evil_run: Path, tmp_path: Path) -> None:
    """So that what follows tests something."""
    base = OmegaConf.to_container(OmegaConf.load(evil_run / CONFIG).env.base)
    torch.load(base["f"], weights_only=base["weights_only"])
    assert (tmp_path / "owned").exists()


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_refuses(
    command: str, evil_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [key.format(run=evil_run, place=tmp_path / "out") for key in COMMANDS[command]]
    assert call_command(command, *given)
    said = capsys.readouterr().err
    assert CALL in said
    assert str(evil_run / CONFIG) in said
    assert "trusted" in said
    assert not (tmp_path / "owned").exists()


def test_the_figures_of_a_run_refuse(evil_run: Path, tmp_path: Path) -> None:
    from cnfp_torchrl.visual.figures import draw_run_figures

    with pytest.raises(PermissionError, match=re.escape(CALL)):
        draw_run_figures(RunFolder.open(evil_run))
    assert not (tmp_path / "owned").exists()
    assert not (evil_run / "figures").exists()
