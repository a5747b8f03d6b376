from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.tasks.point_nav import Layout, ShortestPath
from cnfp_torchrl.tasks.point_nav.shortest_path import CAUTIOUS
from cnfp_torchrl.training.agent import build_environment
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.train import train
from experiments.paper.afterwards import (
    CHANGES,
    SECOND_RECTANGLE,
    STRICTER_RESERVE,
    changed,
    evaluate_afterwards,
    evaluation,
)
from tests.training.conftest import TINY


@pytest.fixture(params=["exact", "unconstrained"])
def run(request: pytest.FixtureRequest, tmp_path: Path) -> RunFolder:
    """A run of hardly any training: its policy knows nothing of any constraint."""
    folder = RunFolder.create(tmp_path / "run")
    episodes = [key for key in TINY if "max_steps" not in key and "episodes" not in key]
    train(compose_config(*episodes, "evaluation.episodes=40", f"flow={request.param}"), folder)
    return folder


def test_an_untrained_flow_keeps_constraints_that_appear_later(run: RunFolder) -> None:
    config = run.load_config()
    results = evaluate_afterwards(run)
    assert set(results) == set(CHANGES)
    for result in results.values():
        for outcome in result.both:
            assert (outcome.episodes, outcome.steps) == (40, 4000)
            if config.flow._target_.split(".")[-1] == "ExactFlow":
                assert outcome.violations == {"obstacle": 0, "battery": 0}
    if config.flow._target_.endswith("UnconstrainedFlow"):
        before = evaluation(run, config).stochastic.violations
        second = results["second rectangle"].stochastic.violations
        reserve = results["stricter battery reserve"].stochastic.violations
        assert second["obstacle"] > before["obstacle"]
        assert reserve["battery"] > before["battery"]
        assert reserve["obstacle"] == before["obstacle"]


def test_unchanged_it_is_the_evaluation_of_training(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run")
    summary = train(compose_config(*TINY), folder)
    deterministic = evaluation(folder, folder.load_config()).deterministic
    assert deterministic.return_mean == summary["evaluation"]["deterministic"]["return_mean"]


@pytest.mark.parametrize("name", CHANGES)
def test_every_part_of_the_task_has_the_changed_map(name: str) -> None:
    config = compose_config()
    before = OmegaConf.to_container(config, resolve=True)
    new = changed(config, CHANGES[name])
    assert OmegaConf.to_container(config, resolve=True) == before
    expected = CHANGES[name](Layout())
    env = build_environment(new, batch_size=[2])
    found = [env.base_env.layout]
    found += [transform.layout for transform in env.transform if hasattr(transform, "layout")]
    assert len(found) == 3
    assert found == [expected] * 3
    assert instantiate(new.env.baselines, _convert_="all")


def test_a_map_of_the_run_is_kept() -> None:
    config = compose_config("+env.layout.goal_radius=0.2", "+env.layout.rectangles=[[0,0,0.1,0.1]]")
    layout = instantiate(
        changed(config, CHANGES["second rectangle"]).env.base, _convert_="all"
    ).layout
    assert layout.goal_radius == 0.2
    assert layout.rectangles == ((0.0, 0.0, 0.1, 0.1), SECOND_RECTANGLE)


def test_an_environment_without_a_map_is_refused() -> None:
    with pytest.raises(ValueError, match="only point navigation can be changed"):
        changed(DictConfig({"env": {}}), CHANGES["second rectangle"])


def test_the_changes_can_be_kept_from_every_start() -> None:
    # The promise of docs/method.md: the way to a station is within the cautious reach at the start.
    # Here it is checked on a fine grid of starts, with the lowest charge.
    axis = torch.linspace(-0.95, 0.95, 381)
    grid = torch.cartesian_prod(axis, axis)
    for name, change in CHANGES.items():
        layout = change(Layout())
        rectangles = torch.tensor(layout.rectangles)
        m = layout.start_margin
        inside = (grid[:, None] > rectangles[:, :2] - m) & (grid[:, None] < rectangles[:, 2:] + m)
        starts = grid[~inside.all(-1).any(-1)]
        way = ShortestPath(layout).to_station(starts)
        length = (way.waypoint - starts).norm(dim=-1) + way.rest
        steps = layout.battery_start[0] - layout.battery_threshold
        reach = CAUTIOUS * (layout.zone_radius + layout.step_length * steps)
        assert bool(way.found.all()), name
        assert float(length.max()) < reach, name


def test_the_changes_ask_for_more() -> None:
    layout = Layout()
    stations: Any = torch.tensor(layout.stations)
    low, high = torch.tensor(SECOND_RECTANGLE).split(2)
    gap = (torch.maximum(low - stations, stations - high).clamp(min=0)).norm(dim=-1)
    assert float(gap.min()) > layout.zone_radius + layout.step_length
    assert layout.battery_threshold < STRICTER_RESERVE
