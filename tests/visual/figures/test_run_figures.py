"""Every figure of a run, from its folder alone."""

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.training.agent import build_actor, build_environment
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.visual.figures import draw_run_figures
from tests.pictures import is_a_picture

FLOW_FIGURES = {"flow_permissive.png", "flow_restrictive.png"}
ALL = {"learning_curves.png", "trajectories.png", *FLOW_FIGURES}
SEVERAL = [
    "+env.layout.rectangles=[[-0.6,-0.6,-0.2,-0.3],[0.1,-0.2,0.5,0.5]]",
    "+env.layout.stations=[[-0.9,0.0]]",
]

draw = partial(draw_run_figures, episodes=2, dpi=50)

RunFactory = Callable[[DictConfig], RunFolder]


@pytest.fixture
def make_run(tmp_path: Path) -> RunFactory:
    """A run's folder with an untrained actor and no metrics."""

    def make(config: DictConfig) -> RunFolder:
        folder = RunFolder.create(tmp_path / "run")
        folder.save_config(config)
        actor = build_actor(config, build_environment(config, with_anchor=True))
        folder.save_checkpoint(actor=actor)
        return folder

    return make


def configure(*overrides: str) -> DictConfig:
    return compose_config("+env.base.max_steps=20", *overrides)


def pendulum() -> DictConfig:
    """A configuration with another environment: one action, no constraints, no map."""
    config = configure("flow=unconstrained")
    OmegaConf.set_struct(config, value=False)
    config.env = {
        "agents": 1,
        "base": {"_target_": "torchrl.envs.GymEnv", "env_name": "Pendulum-v1"},
        "geometry": {},
    }
    return config


def check(folder: RunFolder, expected: set[str]) -> None:
    before = torch.random.get_rng_state()
    paths = draw(folder)
    assert {path.name for path in paths} == expected
    assert set((folder.path / "figures").iterdir()) == set(paths)
    assert all(is_a_picture(path) for path in paths)
    # A training run that goes on must not notice.
    assert torch.equal(torch.random.get_rng_state(), before)


# The exact flow's are drawn below; `test_stages` draws the panels of all flows.
@pytest.mark.parametrize("flow", ["radial", "squash"])
def test_other_flows(flow: str, make_run: RunFactory) -> None:
    check(make_run(configure(f"flow={flow}")), ALL)


def test_several_rectangles(make_run: RunFactory) -> None:
    check(make_run(configure(*SEVERAL)), ALL)


def test_environment_without_map_and_constraints(make_run: RunFactory) -> None:
    check(make_run(pendulum()), ALL - {"trajectories.png"})


def test_same_run_gives_the_same_pictures(make_run: RunFactory) -> None:
    config = configure("figures=png")
    folder = make_run(config)
    check(folder, ALL)
    once = {path.name: path.read_bytes() for path in (folder.path / "figures").iterdir()}
    shutil.rmtree(folder.path / "figures")
    torch.rand(3)
    again = instantiate(config.figures)(folder, episodes=2, dpi=50)
    assert once == {path.name: path.read_bytes() for path in again}


def test_no_figures_configured() -> None:
    assert not configure("figures=none").get("figures")
